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

// Values of `touched`: the brick of a point's cell gets a gradient, a neighbour of it perhaps.
constexpr uint8_t kTouched = 1, kPerhapsTouched = 2;

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
  BrickEntry* bricks;  // [B]
  int32_t call;        // entries of `bricks` with another stamp are old
  uint8_t* touched;    // null: no gradients wanted
};

SNH_INLINE int64_t pairs_per_group(const SimdField& field) {
  return static_cast<int64_t>(field.n_levels) * kPlanes * 2 * W;
}

// hash_brick of a vector of bricks.
SNH_INLINE vecu hash_bricks(uint32_t head, veci i, veci j) {
  vecu h = (reinterpret_cast<vecu>(i) * 0x9E3779B1u) ^ (reinterpret_cast<vecu>(j) * 0x85EBCA77u) ^
           (head * 0xC2B2AE3Du);
  h ^= h >> 15;
  h *= 0x2C1B3C6Du;
  return h ^ (h >> 13);
}

// Asks the hash table for brick `key`, whose number `own` may be -1, and for the three beside it.
inline __attribute__((noinline)) void fill(BrickEntry& entry, const SimdField& field, const Lookup& lookup,
                                           int64_t key, int32_t own) {
  const Brick brick = unpack_key(key);
  bool full = own >= 0 && field.masks[own] == -1;
  if (lookup.touched && own >= 0) lookup.touched[own] |= kTouched;
  for (int c = 1; c < 4; ++c) {
    const int32_t next = find_brick(brick.level, brick.plane, brick.i + (c & 1), brick.j + (c >> 1),
                                    field.probe, field.capacity, field.brick_keys);
    entry.beside[c - 1] = next;
    full = full && next >= 0 && field.masks[next] == -1;
    if (lookup.touched && next >= 0) lookup.touched[next] |= kPerhapsTouched;
  }
  entry.key = key;
  entry.stamp = lookup.call * 2 + full;
}

// The entry of brick `key`; `own` becomes its number. `absent` serves bricks that do not exist.
SNH_INLINE const BrickEntry& find_entry(const SimdField& field, const Lookup& lookup, int64_t key,
                                        uint32_t hash, int32_t& own, BrickEntry& absent) {
  own = field.capacity ? field.probe[hash & static_cast<uint32_t>(field.capacity - 1)] : -1;
  if (__builtin_expect(own >= 0, 1)) {
    const BrickEntry& entry = lookup.bricks[own];
    if (__builtin_expect((entry.stamp >> 1 == lookup.call) & (entry.key == key), 1)) return entry;
  }
  own = find_key(key, hash, field.probe, field.capacity, field.brick_keys);
  BrickEntry& entry = own >= 0 ? lookup.bricks[own] : absent;
  if (own < 0 || entry.stamp >> 1 != lookup.call) fill(entry, field, lookup, key, own);
  return entry;
}

// Numbers of the four bricks (i + c % 2, j + c / 2) of each lane; false if some of them lack vertices. Consecutive
// samples of a ray share bricks, so the hash table is asked once per run of equal lanes, and for the bricks beside
// once per brick and call.
SNH_INLINE bool find_bricks(const SimdField& field, const Lookup& lookup, int level, int plane, veci i,
                            veci j, veci (&number)[4]) {
  int32_t lane_i[W], lane_j[W], lane_hash[W];
  store(lane_i, i);
  store(lane_j, j);
  store(lane_hash, reinterpret_cast<veci>(hash_bricks(static_cast<uint32_t>(level * 4 + plane), i, j)));
  uint32_t first_of_run = bits((i != from_lane_before(i)) | (j != from_lane_before(j))) | 1;
  int32_t full = 1;
  for (veci& one : number) one = veci{};
  while (first_of_run) {
    const int l = __builtin_ctz(first_of_run);
    first_of_run &= first_of_run - 1;
    int32_t own;
    BrickEntry absent;
    const BrickEntry& entry = find_entry(field, lookup, pack_key(level, plane, lane_i[l], lane_j[l]),
                                         static_cast<uint32_t>(lane_hash[l]), own, absent);
    const veci from_here = lanes() >= l;
    number[0] = from_here ? splat(own) : number[0];
    for (int c = 1; c < 4; ++c) number[c] = from_here ? splat(entry.beside[c - 1]) : number[c];
    full &= entry.stamp;
  }
  return full & 1;
}

// Whether vertex `local` of brick `number` exists, by lane.
SNH_INLINE veci vertex_exists(const SimdField& field, veci number, veci local) {
  if (field.n_bricks == 0) return veci{};
  const veci safe = number < 0 ? veci{} : number;
  const veci word = gather(reinterpret_cast<const int32_t*>(field.masks), safe * 2 + (local >> 5));
  return (number >= 0) & (((word >> (local & 31)) & 1) != 0);
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
      store4(rows + c * kFeatureRow,
             load4(s < 0 ? kZeroRow : field.features + static_cast<int64_t>(s) * kFeatureRow));
    }
    lookup.pair[at + l] = rows;
    lookup.pair[at + W + l] = rows + 2 * kFeatureRow;
  }
}

// First stage for the W points of a group. kValid: returns in which lanes all vertices exist.
template <bool kValid>
SNH_INLINE veci find_corners(const SimdField& field, Lookup& lookup, const vec (&x)[3], int group) {
  veci exists = splat(-1);
  const veci side = splat(kBrickSide - 1);
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
      veci number[4];
      const bool full = find_bricks(field, lookup, level, plane, i >> kBrickBits, j >> kBrickBits, number);
      const veci cross_i = (i & side) == side, cross_j = (j & side) == side;
      number[1] = cross_i ? number[1] : number[0];
      number[3] = cross_i ? number[3] : number[2];
      number[2] = cross_j ? number[2] : number[0];
      number[3] = cross_j ? number[3] : number[1];
      veci slot[4];
      for (int c = 0; c < 4; ++c) {
        const veci local = ((i + (c & 1)) & side) | (((j + (c >> 1)) & side) << kBrickBits);
        slot[c] = number[c] * kBrickVertices + local;
        if (kValid && !full) exists &= vertex_exists(field, number[c], local);
      }
      store_addresses(lookup.pair + at, field.features, slot[0]);
      store_addresses(lookup.pair + at + W, field.features, slot[2]);
      store(lookup.fraction + at, fraction[axis_u(plane)]);
      store(lookup.fraction + at + W, fraction[axis_v(plane)]);
      const uint32_t odd = bits(cross_i | (slot[0] < 0) | (slot[2] < 0));
      if (odd) copy_odd_cells(field, lookup, odd, slot, at);
    }
  }
  return exists;
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
  const int64_t first = group * pairs_per_group(field);
  for (int quad = 0; quad < W; quad += 4)
    for (int level = 0; level < field.n_levels; ++level) {
      const int64_t cells = first + level * kPlanes * 2 * W + quad;
      vec4 value[4];
      for (int p = 0; p < 4; ++p) {
        vec8 sum{}, slope[3] = {};
        for (int plane = 0; plane < kPlanes; ++plane) {
          const int64_t at = cells + plane * 2 * W + p;
          const vec8 low = load8(lookup.pair[at]), along_v = load8(lookup.pair[at + W]) - low;
          const vec8 weights = pair_weights(lookup.fraction[at]);
          const vec8 between = low + lookup.fraction[at + W] * along_v;
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
      for (int f = 0; f < field.n_features; ++f)
        store4(encoded + (level * field.n_features + f) * ld + group * W + quad, value[f]);
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
  const int64_t first = group * pairs_per_group(field);
  for (int quad = 0; quad < W; quad += 4) {
    const int n = group * W + quad;
    vec4 along[3][4] = {};
    for (int level = 0; level < field.n_levels; ++level) {
      vec4 grad[4] = {};
      for (int f = 0; f < field.n_features; ++f)
        grad[f] = load4(grad_encoded + (level * field.n_features + f) * ld + n);
      transpose4(grad);
      for (int p = 0; p < 4; ++p) {
        const vec4 per_metre = grad[p] * field.inv_cell[level];
        for (int a = 0; a < 3; ++a, jacobian += kFeatureRow) along[a][p] += per_metre * load4(jacobian);
        if (!kScatter) continue;
        const vec8 grad2 = twice(grad[p]);
        for (int plane = 0; plane < kPlanes; ++plane) {
          const int64_t at = first + (level * kPlanes + plane) * 2 * W + quad + p;
          const vec8 both = grad2 * pair_weights(lookup.fraction[at]), high = lookup.fraction[at + W] * both;
          add_pair(gradient_of(lookup.pair[at], to_gradient), both - high);
          add_pair(gradient_of(lookup.pair[at + W], to_gradient), high);
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
