// ray_sample: depths of the samples on each ray (paper, section III-B).
//
//   depth     [R]      z-depth of the pixel, metres, > 0; not differentiable
//   uniforms  [R, S]   random numbers in [0, 1), S = n_base + n_surface: the place of each sample in its stratum;
//                      not differentiable. Randomness is an argument: 0.5 everywhere gives the uniform grid.
//   z         [R, S]   output: sample depths, metres, ascending per ray; not differentiable
//
// The first n_base strata divide [near * depth, far * depth] (paper: 0.01 and 1.2), the n_surface others divide
// [depth - truncation, depth + truncation]; sample k of n lies at low + (k + u) / n * (high - low). Both sets are
// merged in ascending order, equal depths with the base sample first. A sample behind the camera (depth < truncation)
// is kept as it is: its z is negative or zero and its point lies behind the camera centre.
#pragma once

#include <cstdint>

#include "common/stream.h"

namespace snh {
namespace cpu {

template <typename T>
void ray_sample(const T* depth, const T* uniforms, int64_t n_rays, int n_base, int n_surface, T near, T far,
                T truncation, T* z);

}  // namespace cpu
namespace cuda {

void ray_sample(const float* depth, const float* uniforms, int64_t n_rays, int n_base, int n_surface,
                float near, float far, float truncation, float* z, Stream stream);

}  // namespace cuda
}  // namespace snh
