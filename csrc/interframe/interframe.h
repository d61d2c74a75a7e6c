// interframe: colour differences between the rays of a frame and the keyframe they project into (paper, eq. 13), with
// their derivative to the frame's pose. Nothing here is differentiable: the Jacobian is an output.
//
//   points_c  [R, 3]     points of the frame in its camera frame, metres: z-depth times the ray
//   color     [R, 3]     colour C_q of each ray, 0..1
//   T_kc      [4, 4]     frame's camera to keyframe's camera, row-major; rigid
//   image     [H, W, 3]  the keyframe, 0..255
//   pinhole              of the keyframe, pixels; the first pixel's centre is (0, 0)
//   residuals [R, 3]     output: C_q_hat - C_q, with C_q_hat / 255 interpolated bilinearly at q_hat = Pi(T_kc p)
//   jacobian  [R, 3, 6]  output: d residuals / d twist at zero, where T_kc <- T_kc exp(twist), twist = (rho, phi) in
//                        metres and radians; the same for T_wc, as T_kc = T_kw T_wc
//   valid     [R]        output: z > 0 in the keyframe's camera and q_hat at least one pixel inside the outermost
//                        pixels' centres (1 <= u <= W - 2, 1 <= v <= H - 2); others get zero residuals and Jacobian
//
// The image gradient is that of the bilinear interpolant, so the Jacobian is the exact derivative of the residuals
// except on the lines between pixel centres. Occlusion is not tested: a robust weight has to take it.
#pragma once

#include <cstdint>

#include "common/stream.h"

namespace snh {

template <typename T>
struct Pinhole {
  T fx, fy, cx, cy;  // pixels
};

namespace cpu {

template <typename T>
void interframe(const T* points_c, const T* color, const T* T_kc, const uint8_t* image, int height, int width,
                const Pinhole<T>& pinhole, int64_t n_rays, T* residuals, T* jacobian, bool* valid);

}  // namespace cpu
namespace cuda {

void interframe(const float* points_c, const float* color, const float* T_kc, const uint8_t* image,
                int height, int width, const Pinhole<float>& pinhole, int64_t n_rays, float* residuals,
                float* jacobian, bool* valid, Stream stream);

}  // namespace cuda
}  // namespace snh
