// One thread per ray.
#include <cmath>

#include "common/kernel.cuh"
#include "interframe/interframe.h"

namespace snh::cuda {
namespace {

constexpr int kThreads = 128;

struct Vec3 {
  float x, y, z;
};
__device__ Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// One channel of the keyframe between four pixels, 0..1, and its derivatives, 1/px.
struct Sample {
  float value, d_u, d_v;
};
__device__ Sample sample(const uint8_t* first, int64_t row_bytes, float p, float q) {
  const float c00 = first[0] / 255.0f, c10 = first[3] / 255.0f, c01 = first[row_bytes] / 255.0f,
              c11 = first[row_bytes + 3] / 255.0f;
  return {(1 - q) * ((1 - p) * c00 + p * c10) + q * ((1 - p) * c01 + p * c11),
          (1 - q) * (c10 - c00) + q * (c11 - c01), (1 - p) * (c01 - c00) + p * (c11 - c10)};
}

// The formulas and their derivation stand in interframe_cpu.cpp.
__global__ void __launch_bounds__(kThreads)
    interframe_kernel(const float* points_c, const float* color, const float* T_kc, const uint8_t* image,
                      int height, int width, Pinhole<float> pinhole, int64_t n_rays, float* residuals,
                      float* jacobian, bool* valid) {
  const int64_t r = global_thread();
  if (r >= n_rays) return;
  const Vec3 p_c{points_c[3 * r], points_c[3 * r + 1], points_c[3 * r + 2]};
  const auto row = [&](int k) {
    return T_kc[4 * k] * p_c.x + T_kc[4 * k + 1] * p_c.y + T_kc[4 * k + 2] * p_c.z + T_kc[4 * k + 3];
  };
  const Vec3 p_k{row(0), row(1), row(2)};
  const float inv_z = 1 / p_k.z;
  const float u = pinhole.fx * p_k.x * inv_z + pinhole.cx, v = pinhole.fy * p_k.y * inv_z + pinhole.cy;
  const bool inside = p_k.z > 0 && u >= 1 && u <= width - 2 && v >= 1 && v <= height - 2;
  valid[r] = inside;
  if (!inside) {
    for (int k = 0; k < 3; ++k) residuals[3 * r + k] = 0;
    for (int k = 0; k < 18; ++k) jacobian[18 * r + k] = 0;
    return;
  }
  const int left = static_cast<int>(floorf(u)), top = static_cast<int>(floorf(v));
  const int64_t row_bytes = int64_t{3} * width;
  // Rows of dPi/dp_k R.
  const float u_x = pinhole.fx * inv_z, u_z = -u_x * p_k.x * inv_z, v_y = pinhole.fy * inv_z,
              v_z = -v_y * p_k.y * inv_z;
  const Vec3 d_u{u_x * T_kc[0] + u_z * T_kc[8], u_x * T_kc[1] + u_z * T_kc[9],
                 u_x * T_kc[2] + u_z * T_kc[10]};
  const Vec3 d_v{v_y * T_kc[4] + v_z * T_kc[8], v_y * T_kc[5] + v_z * T_kc[9],
                 v_y * T_kc[6] + v_z * T_kc[10]};
  for (int c = 0; c < 3; ++c) {
    const Sample s = sample(image + top * row_bytes + int64_t{3} * left + c, row_bytes, u - left, v - top);
    residuals[3 * r + c] = s.value - color[3 * r + c];
    const Vec3 a{s.d_u * d_u.x + s.d_v * d_v.x, s.d_u * d_u.y + s.d_v * d_v.y, s.d_u * d_u.z + s.d_v * d_v.z};
    const Vec3 b = cross(p_c, a);
    float* J = jacobian + 18 * r + 6 * c;
    J[0] = a.x, J[1] = a.y, J[2] = a.z, J[3] = b.x, J[4] = b.y, J[5] = b.z;
  }
}

}  // namespace

void interframe(const float* points_c, const float* color, const float* T_kc, const uint8_t* image,
                int height, int width, const Pinhole<float>& pinhole, int64_t n_rays, float* residuals,
                float* jacobian, bool* valid, Stream stream) {
  if (n_rays == 0) return;
  SNH_LAUNCH(interframe_kernel, blocks_for(n_rays, kThreads), kThreads, 0, stream, points_c, color, T_kc,
             image, height, width, pinhole, n_rays, residuals, jacobian, valid);
}

}  // namespace snh::cuda
