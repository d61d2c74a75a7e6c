// One thread per sample; threads of a warp lie on the same ray or two, so loads and stores are nearly contiguous.
#include "ray_sample/ray_sample.cuh"
#include "ray_sample/ray_sample.h"

namespace snh::cuda {
namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads)
    ray_sample_kernel(const float* depth, const float* uniforms, int64_t n_rays, int n_base, int n_surface,
                      float near, float far, float truncation, float* z) {
  const int n_samples = n_base + n_surface;
  const int64_t n = global_thread();
  if (n >= n_rays * n_samples) return;
  const int64_t ray = n / n_samples, first = ray * n_samples;
  const Strata base = base_strata(depth[ray], uniforms + first, n_base, near, far);
  const Strata surface = surface_strata(depth[ray], uniforms + first + n_base, n_surface, truncation);
  place_sample(base, surface, static_cast<int>(n - first), z + first);
}

}  // namespace

void ray_sample(const float* depth, const float* uniforms, int64_t n_rays, int n_base, int n_surface,
                float near, float far, float truncation, float* z, Stream stream) {
  const int64_t n = n_rays * (n_base + n_surface);
  if (n == 0) return;
  SNH_LAUNCH(ray_sample_kernel, blocks_for(n, kThreads), kThreads, 0, stream, depth, uniforms, n_rays, n_base,
             n_surface, near, far, truncation, z);
}

}  // namespace snh::cuda
