// ray_render: colour and depth of each ray from the samples on it (paper, eq. 6-7).
//
//   tsdf       [R, S]     signed distance of each sample in units of the truncation: 1 in free space, 0 at the surface
//   color      [R, S, 3]  colour of each sample
//   z          [R, S]     depth of each sample, metres, ascending per ray
//   sharpness  scalar     w = sigmoid(s sharpness) sigmoid(-s sharpness); the paper: 1 / T_r; not differentiable
//   cut_behind scalar     metres; infinity = no cut; not differentiable
//   color_ray  [R, 3]     output: sum_i p_i color_i
//   depth_ray  [R]        output: sum_i p_i z_i, metres
//   weight     [R, S]     output: p_i = w_i / (sum_j w_j + kWeightEpsilon)
//
// A ray without samples, or whose samples all have weight zero, renders as zero colour and zero depth.
//
// The cut: eq. 6 is even in s, so behind the first surface on a ray every later sign change of the field (the back of
// a wall, a floor under a table) would weigh as much as the surface that the camera saw. The first crossing is the
// first sample k with s_k > 0 >= s_{k+1}; samples with z > z_k + cut_behind have weight zero. A ray without crossing
// is not cut.
//
// Gradients go from all three outputs to tsdf, color and z; where the cut lies is a constant. With
// g_i = dL/dp_i = dL/dweight_i + dL/dcolor_ray . color_i + dL/ddepth_ray z_i and g_mean = sum_i p_i g_i:
//
//   dL/dtsdf_i  = -sharpness tanh(s_i sharpness / 2) p_i (g_i - g_mean)     as w'(x) = -tanh(x/2) w(x)
//   dL/dcolor_i = p_i dL/dcolor_ray
//   dL/dz_i     = p_i dL/ddepth_ray
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>

#include "common/hd.h"
#include "common/parallel.h"
#include "common/stream.h"

namespace snh {

// Added to the sum of weights: rays far from every surface divide by it.
constexpr double kWeightEpsilon = 1e-8;

// The depth beyond which samples have weight zero: z_k + cut_behind at the first crossing k, else infinity.
template <typename T>
SNH_HD inline T cut_depth(const T* tsdf, const T* z, int n_samples, T cut_behind) {
  for (int k = 0; k + 1 < n_samples; ++k)
    if (tsdf[k] > 0 && tsdf[k + 1] <= 0) return z[k] + cut_behind;
  return std::numeric_limits<T>::infinity();
}

// Eq. 6 with x = s * sharpness, as e / (1 + e)^2 with e = exp(-|x|), which neither overflows nor cancels.
template <typename T>
SNH_HD inline T bell(T x) {
  const T e = std::exp(-std::abs(x));
  return e / ((T(1) + e) * (T(1) + e));
}

namespace cpu {

template <typename T>
void ray_render(const T* tsdf, const T* color, const T* z, int64_t n_rays, int n_samples, T sharpness,
                T cut_behind, const ParallelFor& over_rays, T* color_ray, T* depth_ray, T* weight);

// grad_color_ray [R, 3], grad_depth_ray [R], grad_weight [R, S] and the forward's weight come in; grad_tsdf [R, S],
// grad_color [R, S, 3], grad_z [R, S] are written.
template <typename T>
void ray_render_backward(const T* grad_color_ray, const T* grad_depth_ray, const T* grad_weight,
                         const T* tsdf, const T* color, const T* z, const T* weight, int64_t n_rays,
                         int n_samples, T sharpness, const ParallelFor& over_rays, T* grad_tsdf,
                         T* grad_color, T* grad_z);

}  // namespace cpu
namespace cuda {

void ray_render(const float* tsdf, const float* color, const float* z, int64_t n_rays, int n_samples,
                float sharpness, float cut_behind, float* color_ray, float* depth_ray, float* weight,
                Stream stream);

void ray_render_backward(const float* grad_color_ray, const float* grad_depth_ray, const float* grad_weight,
                         const float* tsdf, const float* color, const float* z, const float* weight,
                         int64_t n_rays, int n_samples, float sharpness, float* grad_tsdf, float* grad_color,
                         float* grad_z, Stream stream);

}  // namespace cuda
}  // namespace snh
