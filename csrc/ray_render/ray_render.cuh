// The cut of ray_render.h, found by a warp.
#pragma once

#include "common/kernel.cuh"
#include "ray_render/ray_render.h"

namespace snh::cuda {

// The depth beyond which samples have weight zero, the same in every lane; all 32 lanes must call.
__device__ inline float warp_cut_depth(const float* tsdf, const float* z, int n_samples, float cut_behind) {
  if (cut_behind == HUGE_VALF) return HUGE_VALF;
  for (int first = 0; first + 1 < n_samples; first += kWarp) {
    const int k = first + static_cast<int>(threadIdx.x) % kWarp;
    const unsigned crossings = __ballot_sync(kFullMask, k + 1 < n_samples && tsdf[k] > 0 && tsdf[k + 1] <= 0);
    if (crossings) return z[first + __ffs(crossings) - 1] + cut_behind;
  }
  return HUGE_VALF;
}

}  // namespace snh::cuda
