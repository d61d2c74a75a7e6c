// One warp per ray, the lanes share its samples. Sums go over the lanes in a fixed order: the same input gives the same
// output, bit for bit.
#include "common/kernel.cuh"
#include "ray_render/ray_render.cuh"
#include "ray_render/ray_render.h"

namespace snh::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kRays = kThreads / kWarp;  // per block

__device__ int64_t ray_of_warp() { return global_thread() / kWarp; }

__global__ void __launch_bounds__(kThreads)
    ray_render_kernel(const float* tsdf, const float* color, const float* z, int64_t n_rays, int n_samples,
                      float sharpness, float cut_behind, float* color_ray, float* depth_ray, float* weight) {
  const int64_t ray = ray_of_warp(), first = ray * n_samples;
  if (ray >= n_rays) return;
  const int lane = threadIdx.x % kWarp;
  tsdf += first, color += 3 * first, z += first, weight += first;

  const float limit = warp_cut_depth(tsdf, z, n_samples, cut_behind);
  float sum = 0;
  for (int i = lane; i < n_samples; i += kWarp) {
    const float w = z[i] > limit ? 0.0f : bell(tsdf[i] * sharpness);  // eq. 6
    weight[i] = w;
    sum += w;
  }
  const float total = warp_sum(sum) + static_cast<float>(kWeightEpsilon);

  float red = 0, green = 0, blue = 0, depth = 0;
  for (int i = lane; i < n_samples; i += kWarp) {  // eq. 7
    const float p = weight[i] / total;
    weight[i] = p;
    red += p * color[3 * i];
    green += p * color[3 * i + 1];
    blue += p * color[3 * i + 2];
    depth += p * z[i];
  }
  red = warp_sum(red), green = warp_sum(green), blue = warp_sum(blue), depth = warp_sum(depth);
  if (lane != 0) return;
  color_ray[3 * ray] = red;
  color_ray[3 * ray + 1] = green;
  color_ray[3 * ray + 2] = blue;
  depth_ray[ray] = depth;
}

__global__ void __launch_bounds__(kThreads)
    ray_render_backward_kernel(const float* grad_color_ray, const float* grad_depth_ray,
                               const float* grad_weight, const float* tsdf, const float* color,
                               const float* z, const float* weight, int64_t n_rays, int n_samples,
                               float sharpness, float* grad_tsdf, float* grad_color, float* grad_z) {
  const int64_t ray = ray_of_warp(), first = ray * n_samples;
  if (ray >= n_rays) return;
  const int lane = threadIdx.x % kWarp;
  tsdf += first, color += 3 * first, z += first, weight += first, grad_weight += first;
  grad_tsdf += first, grad_color += 3 * first, grad_z += first;
  const float red = grad_color_ray[3 * ray], green = grad_color_ray[3 * ray + 1],
              blue = grad_color_ray[3 * ray + 2];
  const float dz = grad_depth_ray[ray];

  const auto gradient = [&](int i) {  // g_i of the contract
    return grad_weight[i] + red * color[3 * i] + green * color[3 * i + 1] + blue * color[3 * i + 2] +
           dz * z[i];
  };
  float sum = 0;
  for (int i = lane; i < n_samples; i += kWarp) sum += weight[i] * gradient(i);
  const float mean = warp_sum(sum);
  for (int i = lane; i < n_samples; i += kWarp) {
    const float p = weight[i];
    grad_tsdf[i] = -sharpness * tanhf(tsdf[i] * (sharpness / 2)) * p * (gradient(i) - mean);
    grad_color[3 * i] = p * red;
    grad_color[3 * i + 1] = p * green;
    grad_color[3 * i + 2] = p * blue;
    grad_z[i] = p * dz;
  }
}

}  // namespace

void ray_render(const float* tsdf, const float* color, const float* z, int64_t n_rays, int n_samples,
                float sharpness, float cut_behind, float* color_ray, float* depth_ray, float* weight,
                Stream stream) {
  if (n_rays == 0) return;
  SNH_LAUNCH(ray_render_kernel, blocks_for(n_rays, kRays), kThreads, 0, stream, tsdf, color, z, n_rays,
             n_samples, sharpness, cut_behind, color_ray, depth_ray, weight);
}

void ray_render_backward(const float* grad_color_ray, const float* grad_depth_ray, const float* grad_weight,
                         const float* tsdf, const float* color, const float* z, const float* weight,
                         int64_t n_rays, int n_samples, float sharpness, float* grad_tsdf, float* grad_color,
                         float* grad_z, Stream stream) {
  if (n_rays == 0) return;
  SNH_LAUNCH(ray_render_backward_kernel, blocks_for(n_rays, kRays), kThreads, 0, stream, grad_color_ray,
             grad_depth_ray, grad_weight, tsdf, color, z, weight, n_rays, n_samples, sharpness, grad_tsdf,
             grad_color, grad_z);
}

}  // namespace snh::cuda
