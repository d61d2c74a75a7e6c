// SNH_HD marks the functions that host and device share, letter for letter. In a file that is compiled once per
// instruction set they are always inlined, so that no symbol of one set can stand in for another's.
#pragma once

#ifdef __CUDACC__
#define SNH_HD __host__ __device__
#elif defined(SNH_SIMD)
#define SNH_HD __attribute__((always_inline))
#else
#define SNH_HD
#endif
