#include "hull_cells/hull_cells.h"

#include <algorithm>
#include <cmath>
#include <tuple>

#include "common/check.h"
#include "common/lattice.h"

namespace snh {

namespace {

constexpr const char* kOp = "hull_cells";

template <typename Value>
Tensor to_tensor(const std::vector<Value>& values, const Tensor& like, const std::vector<int64_t>& shape,
                 ScalarType type) {
  Tensor result = torch::stable::new_empty(like, shape, type);
  std::copy(values.begin(), values.end(), out<Value>(result));
  return result;
}

void check_points(const Tensor& points, const Tensor& origin, double hull_scale) {
  check_floating(kOp, "points", points);
  check_dtype(kOp, "origin", origin, points.scalar_type());
  check_shape(kOp, "points", points, {-1, 3});
  check_shape(kOp, "origin", origin, {3});
  STD_TORCH_CHECK(hull_scale > 0 && std::isfinite(hull_scale), "snh::", kOp,
                  ": argument 'hull_scale' must be positive, got ", hull_scale);
}

std::tuple<Tensor, Tensor> hull_cells(const Tensor& points, const Tensor& origin,
                                      const std::vector<double>& cell_sizes, double hull_scale) {
  check_points(points, origin, hull_scale);
  const int n_levels = static_cast<int>(cell_sizes.size());
  STD_TORCH_CHECK(n_levels >= 1 && n_levels <= kMaxLevels, "snh::", kOp,
                  ": argument 'cell_sizes' must have 1 to ", kMaxLevels, " levels, got ", n_levels);
  for (const double size : cell_sizes)
    STD_TORCH_CHECK(size > 0 && std::isfinite(size), "snh::", kOp,
                    ": argument 'cell_sizes' must be positive metres, got ", size);
  const Tensor p = torch::stable::contiguous(points), o = torch::stable::contiguous(origin);

  const auto call = [&](auto zero) {
    using T = decltype(zero);
    return cpu::hull_cells<T>(in<T>(p), p.size(0), in<T>(o), cell_sizes.data(), n_levels, hull_scale);
  };
  const cpu::Bricks bricks = p.scalar_type() == ScalarType::Float ? call(0.0f) : call(0.0);
  const int64_t n_bricks = static_cast<int64_t>(bricks.keys.size());
  return {to_tensor(bricks.keys, p, {n_bricks}, ScalarType::Long),
          to_tensor(bricks.masks, p, {n_bricks}, ScalarType::Long)};
}

Tensor plane_hull(const Tensor& points, const Tensor& origin, int64_t plane, double hull_scale) {
  check_points(points, origin, hull_scale);
  STD_TORCH_CHECK(plane >= 0 && plane < kPlanes, "snh::plane_hull: argument 'plane' must be 0, 1 or 2, got ",
                  plane);
  const Tensor p = torch::stable::contiguous(points), o = torch::stable::contiguous(origin);
  const auto call = [&](auto zero) {
    using T = decltype(zero);
    const std::vector<T> corners =
        cpu::plane_hull<T>(in<T>(p), p.size(0), in<T>(o), static_cast<int>(plane), hull_scale);
    return to_tensor(corners, p, {static_cast<int64_t>(corners.size()) / 2, 2}, p.scalar_type());
  };
  return p.scalar_type() == ScalarType::Float ? call(0.0f) : call(0.0);
}

}  // namespace

}  // namespace snh

STABLE_TORCH_LIBRARY_FRAGMENT(snh, m) {
  m.def(
      "hull_cells(Tensor points, Tensor origin, float[] cell_sizes, float hull_scale) -> (Tensor keys, "
      "Tensor masks)");
  m.def("plane_hull(Tensor points, Tensor origin, int plane, float hull_scale) -> Tensor");
}
STABLE_TORCH_LIBRARY_IMPL(snh, CPU, m) {
  m.impl("hull_cells", TORCH_BOX(&snh::hull_cells));
  m.impl("plane_hull", TORCH_BOX(&snh::plane_hull));
}
