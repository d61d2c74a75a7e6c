// Look-up in the planes on the device: where a point lies, gathering rows, and adding gradients to them.
#pragma once

#include "common/cell.h"
#include "common/kernel.cuh"
#include "common/lattice.h"

namespace snh::cuda {

__device__ inline float4 operator*(float4 a, float s) {
  return make_float4(a.x * s, a.y * s, a.z * s, a.w * s);
}
__device__ inline float4 operator*(float4 a, float4 b) {
  return make_float4(a.x * b.x, a.y * b.y, a.z * b.z, a.w * b.w);
}
__device__ inline float4 operator+(float4 a, float4 b) {
  return make_float4(a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w);
}
__device__ inline float dot(float4 a, float4 b) { return a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w; }

// Up to four neighbouring columns of a table of rows; those beyond `n` read as zero and are not written. `vector`: the
// four lie in 16 aligned bytes.
struct Columns {
  int first, n;
  bool vector;
  int64_t stride;  // floats per row

  __device__ float4 load(const float* rows, int64_t slot) const {
    const float* row = rows + slot * stride + first;
    float4 value = vector ? *reinterpret_cast<const float4*>(row)
                          : make_float4(row[0], n > 1 ? row[1] : 0, n > 2 ? row[2] : 0, n > 3 ? row[3] : 0);
    if (n < 2) value.y = 0;
    if (n < 3) value.z = 0;
    if (n < 4) value.w = 0;
    return value;
  }
  __device__ void atomic_add(float* rows, int64_t slot, float4 value) const {
    float* row = rows + slot * stride + first;
    if (vector) return atomic_add4(reinterpret_cast<float4*>(row), value);
    atomicAdd(row, value.x);
    if (n > 1) atomicAdd(row + 1, value.y);
    if (n > 2) atomicAdd(row + 2, value.z);
    if (n > 3) atomicAdd(row + 3, value.w);
  }
};

// Up to four neighbouring numbers of a plain array.
__device__ inline float4 load_some(const float* from, int n) {
  return make_float4(from[0], n > 1 ? from[1] : 0, n > 2 ? from[2] : 0, n > 3 ? from[3] : 0);
}
__device__ inline void store_some(float* to, float4 value, int n) {
  to[0] = value.x;
  if (n > 1) to[1] = value.y;
  if (n > 2) to[2] = value.z;
  if (n > 3) to[3] = value.w;
}

// Where a point lies on one plane and level.
struct Cell {
  int32_t i, j;
  float p, q;              // place in the cell, [0, 1)
  int64_t slot[kCorners];  // -1 = absent

  __device__ Cell() {}
  // Of an idle lane: no vertex.
  __device__ static Cell nowhere() {
    Cell cell;
    cell.i = cell.j = 0;
    cell.p = cell.q = 0;
    cell.slot[0] = cell.slot[1] = cell.slot[2] = cell.slot[3] = -1;
    return cell;
  }
  __device__ Cell(const float point[3], int level, int plane, float inv_cell, const TableView& table) {
    const float u = to_cells(point[axis_u(plane)], inv_cell), v = to_cells(point[axis_v(plane)], inv_cell);
    i = floor_cell(u), j = floor_cell(v);
    p = u - static_cast<float>(i), q = v - static_cast<float>(j);
    corner_slots(level, plane, i, j, table, slot);
  }
  __device__ bool complete() const { return slot[0] >= 0 && slot[1] >= 0 && slot[2] >= 0 && slot[3] >= 0; }
  // Bilinear weight of a corner and its derivatives to p and q.
  __device__ float b(int c) const { return (c & 1 ? p : 1 - p) * (c >> 1 ? q : 1 - q); }
  __device__ float b_p(int c) const { return (c & 1 ? 1.0f : -1.0f) * (c >> 1 ? q : 1 - q); }
  __device__ float b_q(int c) const { return (c & 1 ? p : 1 - p) * (c >> 1 ? 1.0f : -1.0f); }
};

// Sum over the corners that exist of weight(corner) times their rows.
template <typename Weight>
__device__ float4 sum_corners(const Cell& cell, const Columns& columns, const float* rows,
                              const Weight& weight) {
  float4 sum = zero4();
#pragma unroll
  for (int c = 0; c < kCorners; ++c)
    if (cell.slot[c] >= 0) sum = sum + columns.load(rows, cell.slot[c]) * weight(c);
  return sum;
}

// Runs of neighbouring lanes that lie in the same cell, as samples of a ray do on coarse levels.
struct Runs {
  unsigned heads;  // lanes that begin one
  int last;        // last lane of the own run

  // All 32 lanes must call; an idle one gives any cell.
  __device__ explicit Runs(const Cell& cell) {
    const int lane = threadIdx.x % kWarp;
    const int32_t before_i = __shfl_up_sync(kFullMask, cell.i, 1),
                  before_j = __shfl_up_sync(kFullMask, cell.j, 1);
    heads = __ballot_sync(kFullMask, lane == 0 || before_i != cell.i || before_j != cell.j);
    const unsigned later = lane == kWarp - 1 ? 0 : heads >> (lane + 1);
    last = later ? lane + __ffs(later) - 1 : kWarp - 1;
  }
  __device__ bool is_head() const { return heads >> (threadIdx.x % kWarp) & 1; }

  // In the first lane of each run the sum over the run. All 32 lanes must call.
  __device__ float sum(float value) const {
    const int lane = threadIdx.x % kWarp;
    for (int by = 1; by < kWarp; by *= 2) {
      const float other = __shfl_down_sync(kFullMask, value, by);
      if (lane + by <= last) value += other;
    }
    return value;
  }
};

constexpr int kFewRuns = 8;  // at most so many runs in a warp are summed before they go to memory

// Adds gradient(corner) to the row of each corner that exists, threadIdx.x / 32 being a warp of neighbouring points.
// On coarse levels, where a warp sees few cells, the lanes of a cell are summed first: fewer atomic operations, and
// fewer on the same row. All 32 lanes must call; an idle one has no slots.
template <typename Gradient>
__device__ void scatter_corners(const Cell& cell, const Columns& columns, float* grad_rows,
                                const Gradient& gradient) {
  const Runs runs(cell);
  const bool few = __popc(runs.heads) <= kFewRuns;
#pragma unroll
  for (int c = 0; c < kCorners; ++c) {
    float4 value = cell.slot[c] >= 0 ? gradient(c) : zero4();
    if (few) {
      value.x = runs.sum(value.x);
      if (columns.n > 1) value.y = runs.sum(value.y);
      if (columns.n > 2) value.z = runs.sum(value.z);
      if (columns.n > 3) value.w = runs.sum(value.w);
    }
    if (cell.slot[c] >= 0 && (!few || runs.is_head())) columns.atomic_add(grad_rows, cell.slot[c], value);
  }
}

}  // namespace snh::cuda
