#include "interframe/interframe.h"

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cmath>

namespace snh::cpu {
namespace {

template <typename T>
using Vector3 = Eigen::Matrix<T, 3, 1>;

template <typename T>
struct Sample {
  Vector3<T> color;             // 0..1
  Eigen::Matrix<T, 3, 2> d_uv;  // its derivative, 1/px
};

// Bilinear interpolation at (u, v) inside the image.
template <typename T>
Sample<T> sample(const uint8_t* image, int width, T u, T v) {
  const int column = static_cast<int>(std::floor(u)), row = static_cast<int>(std::floor(v));
  const T p = u - T(column), q = v - T(row);
  const auto pixel = [&](int r, int c) -> Vector3<T> {
    const Eigen::Map<const Eigen::Matrix<uint8_t, 3, 1>> rgb(image +
                                                             (static_cast<int64_t>(r) * width + c) * 3);
    return rgb.template cast<T>() / T(255);
  };
  const Vector3<T> c00 = pixel(row, column), c10 = pixel(row, column + 1), c01 = pixel(row + 1, column),
                   c11 = pixel(row + 1, column + 1);
  Sample<T> s;
  s.color = (1 - q) * ((1 - p) * c00 + p * c10) + q * ((1 - p) * c01 + p * c11);
  s.d_uv.col(0) = (1 - q) * (c10 - c00) + q * (c11 - c01);
  s.d_uv.col(1) = (1 - p) * (c01 - c00) + p * (c11 - c10);
  return s;
}

}  // namespace

template <typename T>
void interframe(const T* points_c, const T* color, const T* T_kc, const uint8_t* image, int height, int width,
                const Pinhole<T>& pinhole, int64_t n_rays, T* residuals, T* jacobian, bool* valid) {
  using Jacobian = Eigen::Matrix<T, 3, 6, Eigen::RowMajor>;
  const Eigen::Map<const Eigen::Matrix<T, 4, 4, Eigen::RowMajor>> pose(T_kc);
  const Eigen::Matrix<T, 3, 3> R = pose.template topLeftCorner<3, 3>();
  const Vector3<T> t = pose.template topRightCorner<3, 1>();

  for (int64_t r = 0; r < n_rays; ++r) {
    const Eigen::Map<const Vector3<T>> p_c(points_c + r * 3), c_q(color + r * 3);
    Eigen::Map<Vector3<T>> residual(residuals + r * 3);
    Eigen::Map<Jacobian> J(jacobian + r * 18);

    const Vector3<T> p_k = R * p_c + t;
    const T inv_z = T(1) / p_k.z();
    const T u = pinhole.fx * p_k.x() * inv_z + pinhole.cx, v = pinhole.fy * p_k.y() * inv_z + pinhole.cy;
    valid[r] = p_k.z() > 0 && u >= 1 && u <= T(width - 2) && v >= 1 && v <= T(height - 2);
    if (!valid[r]) {
      residual.setZero();
      J.setZero();
      continue;
    }
    const Sample<T> q_hat = sample(image, width, u, v);
    residual = q_hat.color - c_q;

    // dC = d_uv  dPi/dp_k  dp_k, and dp_k = R (rho + phi x p_c): with A = d_uv dPi/dp_k R, dC = A rho - A [p_c]x phi.
    Eigen::Matrix<T, 2, 3> d_pi;
    d_pi << pinhole.fx * inv_z, 0, -pinhole.fx * p_k.x() * inv_z * inv_z,  //
        0, pinhole.fy * inv_z, -pinhole.fy * p_k.y() * inv_z * inv_z;
    const Eigen::Matrix<T, 3, 3> A = q_hat.d_uv * (d_pi * R);
    J.template leftCols<3>() = A;
    for (int c = 0; c < 3; ++c) J.row(c).template tail<3>() = p_c.cross(A.row(c).transpose()).transpose();
  }
}

template void interframe(const float*, const float*, const float*, const uint8_t*, int, int,
                         const Pinhole<float>&, int64_t, float*, float*, bool*);
template void interframe(const double*, const double*, const double*, const uint8_t*, int, int,
                         const Pinhole<double>&, int64_t, double*, double*, bool*);

}  // namespace snh::cpu
