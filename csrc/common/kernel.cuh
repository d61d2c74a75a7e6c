// What kernels share: sums over a warp, rows of features, and the instructions that C++ has no word for, each with its
// host version for the shim.
#pragma once

#include <cstdint>

#include "common/launch.cuh"

namespace snh::cuda {

__device__ inline int64_t global_thread() {
  return static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
}

// Sum over the warp, the same in every lane; all 32 lanes must call.
template <typename T>
__device__ inline T warp_sum(T value) {
  for (int bits = kWarp / 2; bits; bits /= 2) value += __shfl_xor_sync(kFullMask, value, bits);
  return value;
}

__device__ inline float4 zero4() { return make_float4(0, 0, 0, 0); }

// Adds to 16 bytes in global memory, aligned to 16. One instruction from sm_90 on; before, one per float, without
// those that are zero (the padding of a row).
__device__ inline void atomic_add4(float4* target, float4 value) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile(
      "red.relaxed.gpu.global.add.v4.f32 [%0], {%1, %2, %3, %4};" ::"l"(__cvta_generic_to_global(target)),
      "f"(value.x), "f"(value.y), "f"(value.z), "f"(value.w)
      : "memory");
#else
  float* const floats = reinterpret_cast<float*>(target);
  atomicAdd(floats, value.x);
  atomicAdd(floats + 1, value.y);
  atomicAdd(floats + 2, value.z);
  if (value.w != 0) atomicAdd(floats + 3, value.w);
#endif
}

}  // namespace snh::cuda
