// What a plane, a level, a cell and a vertex are. Integer decisions live here and in key.h, once for host and
// device, and are compared with ==.
//
//   plane   0 = xy, 1 = yz, 2 = zx; a point (x, y, z) is seen on it at (u, v)
//   level   0 = finest; its cells are squares of side cell_size[level], metres
//   cell    integer (i, j) = floor(u / cell_size), floor(v / cell_size); negative half of the time
//   vertex  corner (i, j) of cells, at (i, j) * cell_size; holds one feature
#pragma once

#include <cmath>
#include <cstdint>

#include "common/hd.h"

namespace snh {

constexpr int kPlanes = 3;
constexpr int kMaxLevels = 16;

// Axes of the plane: u and v are coordinates axis_u(plane) and axis_v(plane) of the point.
SNH_HD inline int axis_u(int plane) { return plane; }
SNH_HD inline int axis_v(int plane) { return plane == 2 ? 0 : plane + 1; }

// Position of a coordinate in cells: `inv_cell` is 1 / cell_size, rounded once in type T by the caller.
// One correctly rounded product on every device, so that floor() of it agrees bit for bit.
template <typename T>
SNH_HD inline T to_cells(T coordinate, T inv_cell) {
  return coordinate * inv_cell;
}

// Cell of a position in cells. Saturates far outside (beyond +-2^29 cells), where no vertex can exist; NaN -> the
// lowest cell, where none exists either.
template <typename T>
SNH_HD inline int32_t floor_cell(T cells) {
  constexpr T kFar = T(1 << 29);
  if (!(cells > -kFar)) return -(1 << 29);
  if (cells > kFar) return 1 << 29;
  return static_cast<int32_t>(std::floor(cells));
}

}  // namespace snh
