#include "ray_render/ray_render.h"

#include <Eigen/Core>

namespace snh::cpu {
namespace {

template <typename T>
using Row = Eigen::Array<T, Eigen::Dynamic, 1>;  // a number per sample
template <typename T>
using Colors = Eigen::Array<T, Eigen::Dynamic, 3, Eigen::RowMajor>;  // a colour per sample
template <typename T>
using Color = Eigen::Array<T, 1, 3>;
template <typename T>
using In = Eigen::Map<const T>;
template <typename T>
using Out = Eigen::Map<T>;

}  // namespace

template <typename T>
void ray_render(const T* tsdf, const T* color, const T* z, int64_t n_rays, int n_samples, T sharpness,
                T cut_behind, const ParallelFor& over_rays, T* color_ray, T* depth_ray, T* weight) {
  const auto render = [&](int64_t r) {
    const In<Row<T>> s(tsdf + r * n_samples, n_samples), z_i(z + r * n_samples, n_samples);
    const In<Colors<T>> c(color + r * n_samples * 3, n_samples, 3);
    Out<Row<T>> p(weight + r * n_samples, n_samples);

    const T limit = cut_depth(s.data(), z_i.data(), n_samples, cut_behind);
    for (int i = 0; i < n_samples; ++i) p[i] = z_i[i] > limit ? T(0) : bell(s[i] * sharpness);  // eq. 6
    p /= p.sum() + T(kWeightEpsilon);

    Out<Color<T>>(color_ray + r * 3) = (c.colwise() * p).colwise().sum();  // eq. 7
    depth_ray[r] = (p * z_i).sum();
  };
  over_rays(n_rays, [&](int64_t begin, int64_t end) {
    for (int64_t r = begin; r < end; ++r) render(r);
  });
}

// The formulas and their derivation stand in the header.
template <typename T>
void ray_render_backward(const T* grad_color_ray, const T* grad_depth_ray, const T* grad_weight,
                         const T* tsdf, const T* color, const T* z, const T* weight, int64_t n_rays,
                         int n_samples, T sharpness, const ParallelFor& over_rays, T* grad_tsdf,
                         T* grad_color, T* grad_z) {
  const auto backward = [&](int64_t r) {
    const In<Row<T>> s(tsdf + r * n_samples, n_samples), z_i(z + r * n_samples, n_samples),
        p(weight + r * n_samples, n_samples), dp(grad_weight + r * n_samples, n_samples);
    const In<Colors<T>> c(color + r * n_samples * 3, n_samples, 3);
    const In<Color<T>> dc(grad_color_ray + r * 3);
    const T dz = grad_depth_ray[r];

    const Row<T> g = dp + (c.matrix() * dc.matrix().transpose()).array() + z_i * dz;
    const T g_mean = (p * g).sum();
    Out<Row<T>>(grad_tsdf + r * n_samples, n_samples) =
        -sharpness * (s * (sharpness / 2)).tanh() * p * (g - g_mean);
    Out<Colors<T>>(grad_color + r * n_samples * 3, n_samples, 3) = (p.matrix() * dc.matrix()).array();
    Out<Row<T>>(grad_z + r * n_samples, n_samples) = p * dz;
  };
  over_rays(n_rays, [&](int64_t begin, int64_t end) {
    for (int64_t r = begin; r < end; ++r) backward(r);
  });
}

#define SNH_INSTANTIATE(T)                                                                                \
  template void ray_render(const T*, const T*, const T*, int64_t, int, T, T, const ParallelFor&, T*, T*,  \
                           T*);                                                                           \
  template void ray_render_backward(const T*, const T*, const T*, const T*, const T*, const T*, const T*, \
                                    int64_t, int, T, const ParallelFor&, T*, T*, T*);
SNH_INSTANTIATE(float)
SNH_INSTANTIATE(double)
#undef SNH_INSTANTIATE

}  // namespace snh::cpu
