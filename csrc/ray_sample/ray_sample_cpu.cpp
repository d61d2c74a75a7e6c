#include "ray_sample/ray_sample.h"

#include <Eigen/Core>
#include <algorithm>
#include <vector>

namespace snh::cpu {

template <typename T>
void ray_sample(const T* depth, const T* uniforms, int64_t n_rays, int n_base, int n_surface, T near, T far,
                T truncation, T* z) {
  using Row = Eigen::Array<T, Eigen::Dynamic, 1>;
  const int n_samples = n_base + n_surface;
  const Row base_index = Row::LinSpaced(n_base, T(0), T(n_base - 1));
  const Row surface_index = Row::LinSpaced(n_surface, T(0), T(n_surface - 1));

  for (int64_t r = 0; r < n_rays; ++r) {
    Eigen::Map<const Row> u(uniforms + r * n_samples, n_samples);
    Eigen::Map<Row> z_ray(z + r * n_samples, n_samples);
    const T d = depth[r];

    const T base_low = near * d, base_step = n_base ? (far * d - base_low) / T(n_base) : T(0);
    const Row base = base_low + (base_index + u.head(n_base)) * base_step;
    const T surface_low = d - truncation, surface_step = n_surface ? T(2) * truncation / T(n_surface) : T(0);
    const Row surface = surface_low + (surface_index + u.tail(n_surface)) * surface_step;

    std::merge(base.data(), base.data() + n_base, surface.data(), surface.data() + n_surface, z_ray.data());
  }
}

template void ray_sample<float>(const float*, const float*, int64_t, int, int, float, float, float, float*);
template void ray_sample<double>(const double*, const double*, int64_t, int, int, double, double, double,
                                 double*);

}  // namespace snh::cpu
