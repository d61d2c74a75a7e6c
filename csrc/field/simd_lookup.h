// Look-up in the planes (eq. 4), in two stages. First, W points at a time, cells, fractions and the addresses of the
// corners; then, point by point, the feature rows are read (or, backward, added to).
//
// Two corners (i, j) and (i+1, j) of a cell are neighbours in their brick, so a cell is two loads of two rows: a pair at
// j and a pair at j+1. Where i+1 lies in the next brick, or a brick is absent, the cell is `odd`: its four rows are
// copied to a scratch place and read from there; backward, the scratch place collects and is added at the end.
#pragma once

#include "common/key.h"
#include "field/field_simd.h"
#include "field/simd_math.h"

namespace snh::SNH_SIMD {

// A cell whose four rows do not lie in two pairs.
struct OddCell {
  int32_t at;       // its first address in `pair`
  int32_t slot[4];  // (i, j), (i+1, j), (i, j+1), (i+1, j+1); negative = absent
};
constexpr int kOddFloats = 4 * kFeatureRow;

// What the first stage leaves for a block. Groups of W points; cell = level * 3 + plane.
struct Lookup {
  const float** pair;  // [group][cell][2][W] rows (i, j) and (i+1, j); the same at j+1
  float* fraction;     // [group][cell][2][W] u and v within the cell, in cells
  OddCell* odd;
  float* scratch;  // [odd cell][4 rows]
  int n_odd;
  uint8_t* touched;  // [B]: set to 1 for bricks that get a gradient, also at -1; null: none wanted
};

SNH_INLINE int64_t pairs_per_group(const SimdField& field) {
  return static_cast<int64_t>(field.n_levels) * kPlanes * 2 * W;
}

// Directory entries of bricks: 2 x number + 1 if all vertices exist, -1 = absent.
SNH_INLINE veci find_entries(const SimdField& field, int level, int plane, veci i, veci j) {
  if (field.directory) {
    const BrickGrid& grid = field.grids[level * kPlanes + plane];
    const veci a = i - grid.i0, b = j - grid.j0;
    const veci inside = (a >= 0) & (a < grid.n_i) & (b >= 0) & (b < grid.n_j);
    return gather(field.directory, inside & (grid.first + a * grid.n_j + b));
  }
  int32_t lane_i[W], lane_j[W];
  store(lane_i, i);
  store(lane_j, j);
  for (int l = 0; l < W; ++l) {
    const int32_t number =
        find_brick(level, plane, lane_i[l], lane_j[l], field.probe, field.capacity, field.brick_keys);
    lane_i[l] = number < 0 ? -1 : number * 2 + (field.masks[number] == -1);
  }
  return load(lane_i);
}

// Whether vertex `slot` exists, by lane; a negative one does not.
SNH_INLINE veci vertex_exists(const SimdField& field, veci slot) {
  if (field.n_bricks == 0) return veci{};
  const veci word = gather(reinterpret_cast<const int32_t*>(field.masks), (slot < 0 ? veci{} : slot) >> 5);
  return (slot >= 0) & (((word >> (slot & 31)) & 1) != 0);
}

SNH_INLINE void touch(uint8_t* touched, veci number) {
  int32_t lane[W];
  store(lane, number);
  for (int l = 0; l < W; ++l) touched[lane[l]] = 1;
}

alignas(16) static const float kZeroRow[kFeatureRow] = {0, 0, 0, 0};

// Points the odd lanes of a cell to copies of their rows.
SNH_INLINE void copy_odd_cells(const SimdField& field, Lookup& lookup, uint32_t odd, const veci (&slot)[4],
                               int64_t at) {
  int32_t lane_slot[4][W];
  for (int c = 0; c < 4; ++c) store(lane_slot[c], slot[c]);
  for (; odd; odd &= odd - 1) {
    const int l = __builtin_ctz(odd);
    OddCell& cell = lookup.odd[lookup.n_odd];
    float* rows = lookup.scratch + static_cast<int64_t>(lookup.n_odd++) * kOddFloats;
    cell.at = static_cast<int32_t>(at + l);
    for (int c = 0; c < 4; ++c) {
      const int32_t s = cell.slot[c] = lane_slot[c][l];
      const float* row = field.features + static_cast<int64_t>(s) * kFeatureRow;
      store4(rows + c * kFeatureRow, load4(s < 0 ? kZeroRow : row));
    }
    lookup.pair[at + l] = rows;
    lookup.pair[at + W + l] = rows + 2 * kFeatureRow;
  }
}

// First stage for the W points of a group. kValid: returns the lanes where not all vertices exist.
template <bool kValid>
SNH_INLINE uint32_t find_corners(const SimdField& field, Lookup& lookup, const vec (&x)[3], int group) {
  const veci side = splat(kBrickSide - 1);
  uint32_t missing = 0;
  int64_t at = group * pairs_per_group(field);
  for (int level = 0; level < field.n_levels; ++level) {
    vec fraction[3];
    veci index[3];
    for (int a = 0; a < 3; ++a) {
      const vec cells =
          min(max(x[a] * field.inv_cell[level], splat(-5.3e8f)), splat(5.3e8f));  // as floor_cell
      index[a] = to_int(cells);
      index[a] += to_float(index[a]) > cells;  // a comparison that holds is -1: floor
      fraction[a] = cells - to_float(index[a]);
    }
    for (int plane = 0; plane < kPlanes; ++plane, at += 2 * W) {
      const veci i = index[axis_u(plane)], j = index[axis_v(plane)];
      const veci brick_i = i >> kBrickBits, brick_j = j >> kBrickBits;
      const veci local_i = i & side, local_j = (j & side) << kBrickBits,
                 local_j1 = ((j + 1) & side) << kBrickBits;
      const veci cross_j = (j & side) == side;
      const bool any_cross_j = bits(cross_j) != 0;
      const veci low = find_entries(field, level, plane, brick_i, brick_j);  // of the pair at j
      veci high = low;                                                       // of the pair at j+1
      if (any_cross_j) high = find_entries(field, level, plane, brick_i, brick_j - cross_j);
      veci slot[4] = {(low >> 1) * kBrickVertices + (local_i | local_j),
                      {},
                      (high >> 1) * kBrickVertices + (local_i | local_j1),
                      {}};
      store_addresses(lookup.pair + at, field.features, slot[0]);
      store_addresses(lookup.pair + at + W, field.features, slot[2]);
      store(lookup.fraction + at, fraction[axis_u(plane)]);
      store(lookup.fraction + at + W, fraction[axis_v(plane)]);
      if (lookup.touched) {
        touch(lookup.touched, low >> 1);
        if (any_cross_j) touch(lookup.touched, high >> 1);
      }

      const veci cross_i = local_i == side;
      const uint32_t odd = bits(cross_i | (low < 0) | (high < 0));
      if (odd) {
        const veci low1 = find_entries(field, level, plane, brick_i - cross_i, brick_j);
        veci high1 = low1;
        if (any_cross_j) high1 = find_entries(field, level, plane, brick_i - cross_i, brick_j - cross_j);
        const veci local_i1 = (i + 1) & side;
        slot[1] = (low1 >> 1) * kBrickVertices + (local_i1 | local_j);
        slot[3] = (high1 >> 1) * kBrickVertices + (local_i1 | local_j1);
        if (lookup.touched) {
          touch(lookup.touched, low1 >> 1);
          if (any_cross_j) touch(lookup.touched, high1 >> 1);
        }
        copy_odd_cells(field, lookup, odd, slot, at);
      }
      if (kValid && (odd || bits((low & high & 1) == 0))) {
        const veci ones = splat(1);
        const veci right = odd ? slot[1] : slot[0] + ones, high_right = odd ? slot[3] : slot[2] + ones;
        missing |= bits(~(vertex_exists(field, slot[0]) & vertex_exists(field, right) &
                          vertex_exists(field, slot[2]) & vertex_exists(field, high_right)));
      }
    }
  }
  return missing;
}

// Weights of a pair at fraction u: 1 - u and u, each for a row.
SNH_INLINE vec8 pair_weights(float u) {
  const vec8 at_zero{1, 1, 1, 1, 0, 0, 0, 0}, slope{-1, -1, -1, -1, 1, 1, 1, 1};
  return at_zero + u * slope;
}

// Floats per point and level that encode_points leaves for points_backward: d encoded / d xyz, per cell.
constexpr int kJacobianFloats = 3 * kFeatureRow;

// Second stage for group `group` of points, which starts at column n: rows of `encoded` [L * F][ld].
template <bool kJacobian>
SNH_INLINE void encode_points(const SimdField& field, const Lookup& lookup, int group, int64_t ld,
                              float* encoded, float* jacobian) {
  const vec8 slope_u{-1, -1, -1, -1, 1, 1, 1, 1};
  const int n_levels = field.n_levels, n_features = field.n_features;
  for (int quad = 0; quad < W; quad += 4) {
    const float* const* pair = lookup.pair + group * pairs_per_group(field) + quad;
    const float* fraction = lookup.fraction + group * pairs_per_group(field) + quad;
    float* out = encoded + group * W + quad;
    for (int level = 0; level < n_levels; ++level, pair += kPlanes * 2 * W, fraction += kPlanes * 2 * W) {
      vec4 value[4];
#pragma GCC unroll 4
      for (int p = 0; p < 4; ++p) {
        vec8 sum{}, slope[3] = {};
        for (int plane = 0; plane < kPlanes; ++plane) {
          const int at = plane * 2 * W + p;
          const vec8 low = load8(pair[at]), along_v = load8(pair[at + W]) - low;
          const vec8 weights = pair_weights(fraction[at]);
          const vec8 between = low + fraction[at + W] * along_v;
          sum += weights * between;
          if (kJacobian) {
            slope[axis_u(plane)] += slope_u * between;
            slope[axis_v(plane)] += weights * along_v;
          }
        }
        value[p] = fold(sum);
        if (kJacobian)
          for (int a = 0; a < 3; ++a, jacobian += kFeatureRow) store4(jacobian, fold(slope[a]));
      }
      transpose4(value);
      for (int f = 0; f < n_features; ++f, out += ld) store4(out, value[f]);
    }
  }
}

// The gradient that belongs to a feature row.
SNH_INLINE float* gradient_of(const float* row, int64_t to_gradient) {
  return reinterpret_cast<float*>(reinterpret_cast<intptr_t>(row) + to_gradient);
}

SNH_INLINE void add_pair(float* pair, vec8 grad) { store8(pair, load8(pair) + grad); }

// Backward of the look-up for a group: from grad_encoded [L * F][ld] to the points, grad_x [3][ld] (written), and, if
// kScatter, to the features. Gradients lie `to_gradient` bytes behind the addresses in `pair`.
template <bool kScatter>
SNH_INLINE void points_backward(const SimdField& field, const Lookup& lookup, int group, int64_t ld,
                                const float* grad_encoded, const float* jacobian, int64_t to_gradient,
                                float* grad_x) {
  const int n_levels = field.n_levels, n_features = field.n_features;
  for (int quad = 0; quad < W; quad += 4) {
    const float* const* pair = lookup.pair + group * pairs_per_group(field) + quad;
    const float* fraction = lookup.fraction + group * pairs_per_group(field) + quad;
    const int n = group * W + quad;
    const float* from = grad_encoded + n;
    vec4 along[3][4] = {};
    for (int level = 0; level < n_levels; ++level, pair += kPlanes * 2 * W, fraction += kPlanes * 2 * W) {
      const float inv_cell = field.inv_cell[level];
      vec4 grad[4] = {};
      for (int f = 0; f < n_features; ++f, from += ld) grad[f] = load4(from);
      transpose4(grad);
#pragma GCC unroll 4
      for (int p = 0; p < 4; ++p) {
        const vec4 per_metre = grad[p] * inv_cell;
        for (int a = 0; a < 3; ++a, jacobian += kFeatureRow) along[a][p] += per_metre * load4(jacobian);
        if (!kScatter) continue;
        const vec8 grad2 = twice(grad[p]);
        for (int plane = 0; plane < kPlanes; ++plane) {
          const int at = plane * 2 * W + p;
          const vec8 both = grad2 * pair_weights(fraction[at]), high = fraction[at + W] * both;
          add_pair(gradient_of(pair[at], to_gradient), both - high);
          add_pair(gradient_of(pair[at + W], to_gradient), high);
        }
      }
    }
    for (int a = 0; a < 3; ++a) {
      transpose4(along[a]);
      store4(grad_x + a * ld + n, (along[a][0] + along[a][1]) + (along[a][2] + along[a][3]));
    }
  }
}

// Before the first points_backward of a block: the scratch rows become gradients of the odd cells, zero.
inline void prepare_odd_cells(const Lookup& lookup, int64_t to_gradient) {
  for (int k = 0; k < lookup.n_odd; ++k) {
    for (int c = 0; c < 4; ++c) store4(lookup.scratch + k * kOddFloats + c * kFeatureRow, vec4{});
    const float** pair = lookup.pair + lookup.odd[k].at;
    pair[0] = gradient_of(pair[0], -to_gradient);
    pair[W] = gradient_of(pair[W], -to_gradient);
  }
}

// After the last points_backward of a block.
inline void add_odd_cells(const Lookup& lookup, float* grad_features) {
  for (int k = 0; k < lookup.n_odd; ++k)
    for (int c = 0; c < 4; ++c) {
      const int32_t slot = lookup.odd[k].slot[c];
      if (slot < 0) continue;
      float* row = grad_features + static_cast<int64_t>(slot) * kFeatureRow;
      store4(row, load4(row) + load4(lookup.scratch + k * kOddFloats + c * kFeatureRow));
    }
}

}  // namespace snh::SNH_SIMD
