// plane_lookup: features of points, interpolated on the three planes of every level (paper, eq. 4).
//
//   points      [N, 3]     world coordinates, metres
//   features    [V, C]     rows of the table, row stride C; the first F <= C of each row are used
//   table                  vertex -> row (common/key.h); V >= 64 x number of bricks
//   inv_cells   [L]        1 / cell size of each level, 1/metres; level 0 = finest; not differentiable
//   encoded     [N, L*F]   output; [N, L*3*F] with kCat: levels outermost, then planes
//   valid       [N, L, 3]  output: all four corners of the cell exist on this level and plane
//
// A point lies in the cell (i, j) = floor(u / cell), floor(v / cell) of each plane, at (p, q) in [0, 1)^2 from its first
// corner; its feature there is phi = sum_c b_c f_c over the corners (i, j), (i+1, j), (i, j+1), (i+1, j+1) with
// b = (1-p)(1-q), p(1-q), (1-p)q, pq. A corner without a vertex counts as zero and gets no gradient; a point that is
// not finite has no vertices. Per level the three phi are summed (kSum), multiplied (kProd) or concatenated (kCat).
//
// Gradients go to points and features; within a cell phi is bilinear, across its border the gradient to points jumps.
// Second derivatives: plane_lookup_double_backward. Sums run in one fixed order (levels in parallel write different
// rows), so results do not depend on the number of threads.
#pragma once

#include <cstdint>

#include "common/cell.h"
#include "common/parallel.h"
#include "common/stream.h"

namespace snh {

enum class Reduce { kSum, kCat, kProd };

template <typename T>
struct PlaneLookup {  // what forward and backwards share
  const T* points;
  int64_t n_points;
  const T* features;
  int64_t stride;  // C
  int n_features;  // F
  TableView table;
  const T* inv_cells;
  int n_levels;
  Reduce reduce;

  SNH_HD int level_width() const { return n_features * (reduce == Reduce::kCat ? 3 : 1); }
  SNH_HD int64_t width() const { return static_cast<int64_t>(n_levels) * level_width(); }
};

namespace cpu {

// Gradients that go out are added to: zero on entry.
template <typename T>
void plane_lookup(const PlaneLookup<T>& in, const ParallelFor& over_points, T* encoded, bool* valid);

// grad_encoded [N, width] -> grad_points [N, 3], grad_features [V, C]; null = not wanted.
template <typename T>
void plane_lookup_backward(const PlaneLookup<T>& in, const T* grad_encoded, const ParallelFor& over_points,
                           const ParallelFor& over_levels, T* grad_points, T* grad_features);

// With grad_* the outputs of the backward, the gradient of sum(v_points * grad_points) + sum(v_features *
// grad_features) to grad_encoded [N, width], to points [N, 3] and, unless null, to features [V, C]. v_points [N, 3],
// v_features [V, C]: null counts as zero.
template <typename T>
void plane_lookup_double_backward(const PlaneLookup<T>& in, const T* grad_encoded, const T* v_points,
                                  const T* v_features, const ParallelFor& over_points,
                                  const ParallelFor& over_levels, T* grad_grad_encoded, T* grad_points,
                                  T* grad_features);

}  // namespace cpu

// On the device gradients to features are sums in no fixed order. inv_cells is host memory.
namespace cuda {

void plane_lookup(const PlaneLookup<float>& in, float* encoded, bool* valid, Stream stream);

void plane_lookup_backward(const PlaneLookup<float>& in, const float* grad_encoded, float* grad_points,
                           float* grad_features, Stream stream);

void plane_lookup_double_backward(const PlaneLookup<float>& in, const float* grad_encoded,
                                  const float* v_points, const float* v_features, float* grad_grad_encoded,
                                  float* grad_points, float* grad_features, Stream stream);

}  // namespace cuda
}  // namespace snh
