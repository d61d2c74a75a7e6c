// Launching kernels, and the few other things that kernels' host side does. The same text compiles with nvcc and, with
// SNH_HOST_SHIM, for the host shim.
//
// A kernel returns early in idle threads unless a barrier or a warp operation follows. Nothing here allocates device
// memory or waits for the device, but for copy_to_host().
#pragma once

#ifdef SNH_HOST_SHIM
#include "common/host_shim.h"
#else
#include <cuda_runtime.h>
#endif

#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>

#include "common/stream.h"

// Static shared memory: an array that the threads of a block share.
// Dynamic shared memory: the SNH_LAUNCH's shared_bytes, from a multiple of 16.
#ifdef SNH_HOST_SHIM
#define SNH_SHARED(type, name, count)  \
  alignas(16) static type name[count]; \
  static uint64_t name##_serial = 0;   \
  ::snh::shim::enter_shared(name, sizeof(name), name##_serial)
#define SNH_DYNAMIC_SHARED(type, name) type* const name = static_cast<type*>(::snh::shim::dynamic_shared)
#else
#define SNH_SHARED(type, name, count) __shared__ __align__(16) type name[count]
#define SNH_DYNAMIC_SHARED(type, name)                        \
  extern __shared__ __align__(16) unsigned char snh_shared[]; \
  type* const name = reinterpret_cast<type*>(snh_shared)
#endif

namespace snh {

constexpr unsigned kFullMask = 0xFFFFFFFFu;
constexpr int kWarp = 32;

// Blocks for n items of `per_block` each. A kernel over more than 2^31 - 1 blocks does not exist here: tensors of
// that size do not fit a device.
inline unsigned blocks_for(int64_t n, int per_block) {
  return static_cast<unsigned>((n + per_block - 1) / per_block);
}

#ifdef SNH_HOST_SHIM

#define SNH_LAUNCH(kernel, grid, block, shared_bytes, stream, ...) \
  (static_cast<void>(stream),                                      \
   ::snh::shim::launch(#kernel, grid, block, shared_bytes, [&]() { kernel(__VA_ARGS__); }))

inline void set_bytes(void* memory, int byte, size_t bytes, Stream) { std::memset(memory, byte, bytes); }
inline void copy_to_host(void* to, const void* from, size_t bytes, Stream) { std::memcpy(to, from, bytes); }

#else

inline void check_cuda(cudaError_t error, const char* what) {
  if (error != cudaSuccess)
    throw std::runtime_error(std::string("snh: ") + what +
                             " failed on the CUDA device: " + cudaGetErrorString(error));
}

// More dynamic shared memory than 48 KiB has to be asked for.
template <typename Kernel>
void allow_shared(Kernel kernel, size_t bytes, const char* name) {
  if (bytes > 48 * 1024)
    check_cuda(
        cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(bytes)),
        name);
}

#define SNH_LAUNCH(kernel, grid, block, shared_bytes, stream, ...) \
  do {                                                             \
    ::snh::allow_shared(kernel, shared_bytes, #kernel);            \
    kernel<<<grid, block, shared_bytes, stream>>>(__VA_ARGS__);    \
    ::snh::check_cuda(cudaGetLastError(), #kernel);                \
  } while (false)

inline void set_bytes(void* memory, int byte, size_t bytes, Stream stream) {
  if (bytes) check_cuda(cudaMemsetAsync(memory, byte, bytes, stream), "cudaMemsetAsync");
}
// Waits for the stream.
inline void copy_to_host(void* to, const void* from, size_t bytes, Stream stream) {
  check_cuda(cudaMemcpyAsync(to, from, bytes, cudaMemcpyDeviceToHost, stream), "cudaMemcpyAsync");
  check_cuda(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

#endif

}  // namespace snh
