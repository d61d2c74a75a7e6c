// hull_cells: which vertices a frame creates (paper, section III-A, eq. 1 and 2).
//
//   points      [N, 3]  points of the frame, world, metres
//   origin      [3]     camera centre, world, metres; one more point
//   cell_sizes  [L]     side of a cell per level, metres
//   hull_scale          mu of eq. 2
//
// Points and origin are seen on each of the three planes (axes: common/lattice.h). Their convex hull is
// scaled by hull_scale about the centroid of its area; a hull without area (one point, points on a line)
// about the mean of its corners. On each level a cell is touched when it is the cell, in the sense of
// floor(), of some point of the closed scaled hull: cells own their lower sides and not their upper ones,
// just as in a look-up. All four vertices of every touched cell are returned. Nothing is differentiable.
//
// Exactness. The corners of the unscaled hull are exact while products of coordinates neither vanish nor
// overflow (1e-150 to 1e150 m). Scaled corners are rounded to T once, brought to cells by the product that a
// look-up uses, and cut to multiples of 2^-32 cells; from there on every decision is integer arithmetic. With
// hull_scale = 1 corners stay the given points, so each point that is a corner finds its own cell.
//
// Throws std::runtime_error, one sentence, when a coordinate is not finite, a hull reaches beyond what keys can
// name, or its bounding box would need more than 2^24 bricks on one plane and level.
#pragma once

#include <cstdint>
#include <vector>

namespace snh::cpu {

// Corners [M, 2] (u, v) in metres of the scaled hull on one plane, counter-clockwise from the one with the
// lowest u (then v); no three on one line before scaling. M = 1 for a single point, 2 for points on a line.
template <typename T>
std::vector<T> plane_hull(const T* points, int64_t n_points, const T* origin, int plane, double hull_scale);

struct Bricks {
  std::vector<int64_t> keys;   // [M] ascending, see common/key.h
  std::vector<int64_t> masks;  // [M] vertices of each brick, never 0
};

template <typename T>
Bricks hull_cells(const T* points, int64_t n_points, const T* origin, const double* cell_sizes, int n_levels,
                  double hull_scale);

}  // namespace snh::cpu
