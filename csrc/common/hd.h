// SNH_HD marks the functions that host and device share, letter for letter.
#pragma once

#ifdef __CUDACC__
#define SNH_HD __host__ __device__
#else
#define SNH_HD
#endif
