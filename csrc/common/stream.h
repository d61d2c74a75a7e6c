// The CUDA stream of a call, for headers that must compile without CUDA.
#pragma once

struct CUstream_st;

namespace snh {

using Stream = CUstream_st*;  // cudaStream_t

}  // namespace snh
