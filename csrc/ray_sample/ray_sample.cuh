// The samples of one ray on the device. Every thread finds the depth of its own sample and its place among all, without
// the others' help: both sets ascend, so the place is the own number plus that of the earlier samples of the other set.
//
// Products and sums are rounded one by one (no fused multiply-add): depths equal the CPU's bit for bit, and a depth is
// the same in every thread that computes it.
#pragma once

#include "common/kernel.cuh"

namespace snh::cuda {

// The strata of one of the two sets: sample k lies at low + (k + u_k) step.
struct Strata {
  const float* uniforms;  // [n]
  int n;
  float low, step;

  __device__ float depth(int k) const {
    return __fadd_rn(low, __fmul_rn(__fadd_rn(static_cast<float>(k), uniforms[k]), step));
  }
  // How many samples lie before z; those at z count if `with_equal`.
  __device__ int count_before(float z, bool with_equal) const {
    int first = 0, last = n;
    while (first < last) {
      const int middle = (first + last) / 2;
      const float other = depth(middle);
      if (other < z || (with_equal && other == z))
        first = middle + 1;
      else
        last = middle;
    }
    return first;
  }
};

// uniforms: those of this ray, base first.
__device__ inline Strata base_strata(float depth, const float* uniforms, int n_base, float near, float far) {
  const float low = __fmul_rn(near, depth);
  return {uniforms, n_base, low,
          n_base ? __fsub_rn(__fmul_rn(far, depth), low) / static_cast<float>(n_base) : 0.0f};
}
__device__ inline Strata surface_strata(float depth, const float* uniforms, int n_surface, float truncation) {
  return {uniforms, n_surface, __fsub_rn(depth, truncation),
          n_surface ? __fmul_rn(2.0f, truncation) / static_cast<float>(n_surface) : 0.0f};
}

// Writes sample k of the two sets, base first, to its place in z.
__device__ inline void place_sample(const Strata& base, const Strata& surface, int k, float* z) {
  if (k < base.n) {
    const float depth = base.depth(k);
    z[k + surface.count_before(depth, false)] = depth;
  } else {
    const float depth = surface.depth(k - base.n);
    z[k - base.n + base.count_before(depth, true)] = depth;
  }
}

}  // namespace snh::cuda
