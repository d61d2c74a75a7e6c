// Look-up in the planes (eq. 4), in two stages. Vectors of W points find cells, fractions and the places of their
// corners; then point by point the rows, 16 bytes each, are read (or, backward, added to).
#pragma once

#include "common/key.h"
#include "field/field_simd.h"
#include "field/simd_math.h"

namespace snh::SNH_SIMD {

// Consecutive samples of a ray share bricks, and neighbouring rays do. The hash table is asked once per brick and
// call for the four bricks that the corners of its cells can lie in; this direct-mapped cache remembers.
struct BrickQuad {
  int64_t key;        // of the first brick; -1 = empty entry
  int32_t number[4];  // bricks (i, j), (i+1, j), (i, j+1), (i+1, j+1); -1 = absent
  int32_t full;       // all four exist with all their vertices
  int32_t padding;
};
constexpr int kCacheEntries = 2048;  // 64 kB
constexpr int64_t kCacheFloats = kCacheEntries * sizeof(BrickQuad) / sizeof(float);

// Values of `touched`: the first brick of a quad gets a gradient, the others perhaps.
constexpr uint8_t kTouched = 1, kPerhapsTouched = 2;

inline void clear(BrickQuad* cache) {
  for (int k = 0; k < kCacheEntries; ++k) cache[k].key = -1;
}

inline __attribute__((noinline)) void fill(BrickQuad& quad, const SimdField& field, int64_t key,
                                           uint8_t* touched) {
  const Brick brick = unpack_key(key);
  quad.key = key;
  quad.full = 1;
  for (int c = 0; c < 4; ++c) {
    const int32_t number = find_brick(brick.level, brick.plane, brick.i + (c & 1), brick.j + (c >> 1),
                                      field.probe, field.capacity, field.brick_keys);
    quad.number[c] = number;
    quad.full &= number >= 0 && field.masks[number] == -1;
    if (touched && number >= 0) touched[number] |= c == 0 ? kTouched : kPerhapsTouched;
  }
}

SNH_INLINE const BrickQuad& find_quad(BrickQuad* cache, const SimdField& field, uint32_t hash, int64_t key,
                                      uint8_t* touched) {
  BrickQuad& quad = cache[hash & (kCacheEntries - 1)];
  if (__builtin_expect(quad.key != key, 0)) fill(quad, field, key, touched);
  return quad;
}

// What the first stage leaves for a block, [.][ld]; cell = level * 3 + plane.
struct LookupRows {
  int32_t*
      place;  // [cell * 4 + corner]: 2 * slot (rows are 2 * 8 bytes), negative = absent; corner = di + 2 dj
  float* fraction;  // [cell * 2 + axis] within the cell
  BrickQuad* cache;
  uint8_t* touched;  // null: no gradients wanted
};

// hash_brick of a vector of bricks.
SNH_INLINE vecu hash_bricks(uint32_t head, veci i, veci j) {
  vecu h = (reinterpret_cast<vecu>(i) * 0x9E3779B1u) ^ (reinterpret_cast<vecu>(j) * 0x85EBCA77u) ^
           (head * 0xC2B2AE3Du);
  h ^= h >> 15;
  h *= 0x2C1B3C6Du;
  return h ^ (h >> 13);
}

// Numbers of the four bricks around each lane's brick (i, j); false if some of them lack vertices.
SNH_INLINE bool find_quads(const SimdField& field, const LookupRows& rows, int level, int plane, veci i,
                           veci j, veci (&number)[4]) {
  const vecu hash = hash_bricks(static_cast<uint32_t>(level * 4 + plane), i, j);
  int32_t lane_i[W], lane_j[W], lane_hash[W];
  store(lane_i, i);
  store(lane_j, j);
  store(lane_hash, reinterpret_cast<veci>(hash));
  uint32_t first_of_run = bits((i != from_lane_before(i)) | (j != from_lane_before(j))) | 1;
  bool full = true;
  for (veci& one : number) one = veci{};
  while (first_of_run) {
    const int l = __builtin_ctz(first_of_run);
    first_of_run &= first_of_run - 1;
    const BrickQuad& quad = find_quad(rows.cache, field, static_cast<uint32_t>(lane_hash[l]),
                                      pack_key(level, plane, lane_i[l], lane_j[l]), rows.touched);
    const veci from_here = lanes() >= l;
    for (int c = 0; c < 4; ++c) number[c] = from_here ? splat(quad.number[c]) : number[c];
    full &= quad.full != 0;
  }
  return full;
}

// Whether vertex `local` of brick `number` exists, by lane.
SNH_INLINE veci vertex_exists(const SimdField& field, veci number, veci local) {
  if (field.n_bricks == 0) return veci{};
  const veci safe = number < 0 ? veci{} : number;
  const veci word = gather(reinterpret_cast<const int32_t*>(field.masks), safe * 2 + (local >> 5));
  return (number >= 0) & (((word >> (local & 31)) & 1) != 0);
}

// First stage for W points at column n. Returns whether all bricks exist; `exists` (if kValid) whether all vertices do.
template <bool kValid>
SNH_INLINE bool find_corners(const SimdField& field, const LookupRows& rows, const vec (&x)[3], int n,
                             int64_t ld, veci& exists) {
  veci all_places{};
  exists = splat(-1);
  for (int level = 0; level < field.n_levels; ++level) {
    vec cells[3], fraction[3];
    veci index[3];
    for (int a = 0; a < 3; ++a) {
      cells[a] =
          min(max(x[a] * field.inv_cell[level], splat(-5.3e8f)), splat(5.3e8f));  // as floor_cell saturates
      index[a] = to_int(cells[a]);
      index[a] += to_float(index[a]) > cells[a];  // a comparison that holds is -1: floor
      fraction[a] = cells[a] - to_float(index[a]);
    }
    for (int plane = 0; plane < kPlanes; ++plane) {
      const int cell = level * kPlanes + plane;
      const veci i = index[axis_u(plane)], j = index[axis_v(plane)];
      veci number[4];
      const bool full = find_quads(field, rows, level, plane, i >> kBrickBits, j >> kBrickBits, number);
      const veci side = splat(kBrickSide - 1);
      const veci cross_i = (i & side) == side, cross_j = (j & side) == side;
      number[1] = cross_i ? number[1] : number[0];
      number[3] = cross_i ? number[3] : number[2];
      number[2] = cross_j ? number[2] : number[0];
      number[3] = cross_j ? number[3] : number[1];
      for (int c = 0; c < 4; ++c) {
        const veci local = ((i + (c & 1)) & side) | (((j + (c >> 1)) & side) << kBrickBits);
        const veci place = (number[c] * kBrickVertices + local) * 2;
        store(rows.place + (cell * 4 + c) * ld + n, place);
        all_places |= place;
        if (kValid && !full) exists &= vertex_exists(field, number[c], local);
      }
      store(rows.fraction + (cell * 2) * ld + n, fraction[axis_u(plane)]);
      store(rows.fraction + (cell * 2 + 1) * ld + n, fraction[axis_v(plane)]);
    }
  }
  return bits(all_places < 0) == 0;
}

alignas(16) static const float kZeroRow[4] = {0, 0, 0, 0};

template <bool kComplete>
SNH_INLINE vec4 feature_row(const float* features, int32_t place) {
  const float* row = features + static_cast<int64_t>(place) * 2;
  if (!kComplete) row = place < 0 ? kZeroRow : row;
  return load4(row);
}

// Floats per point that encode_points leaves for the derivative to the point: d encoded / d xyz of each level in cells.
constexpr int kJacobianFloats = 3 * 4;

// Second stage for W points at column n: rows of `encoded` [L * F][ld], and the derivatives for points_backward.
template <bool kComplete, bool kJacobian>
SNH_INLINE void encode_points(const SimdField& field, const LookupRows& rows, int n, int64_t ld,
                              float* encoded, float* jacobian) {
  const int F = field.n_features;
  for (int quad = n; quad < n + W; quad += 4)
    for (int level = 0; level < field.n_levels; ++level) {
      vec4 value[4];
      for (int p = 0; p < 4; ++p) {
        vec4 sum{}, slope[3] = {};
        for (int plane = 0; plane < kPlanes; ++plane) {
          const int cell = level * kPlanes + plane;
          const int32_t* place = rows.place + cell * 4 * ld + quad + p;
          const vec4 r00 = feature_row<kComplete>(field.features, place[0]);
          const vec4 r10 = feature_row<kComplete>(field.features, place[ld]);
          const vec4 r01 = feature_row<kComplete>(field.features, place[2 * ld]);
          const vec4 r11 = feature_row<kComplete>(field.features, place[3 * ld]);
          const float u = rows.fraction[cell * 2 * ld + quad + p],
                      v = rows.fraction[(cell * 2 + 1) * ld + quad + p];
          const vec4 along0 = r10 - r00, along1 = r11 - r01;
          const vec4 low = r00 + u * along0, high = r01 + u * along1;
          sum += low + v * (high - low);
          if (kJacobian) {
            slope[axis_u(plane)] += along0 + v * (along1 - along0);
            slope[axis_v(plane)] += high - low;
          }
        }
        value[p] = sum;
        if (kJacobian)
          for (int a = 0; a < 3; ++a, jacobian += 4) store4(jacobian, slope[a]);
      }
      transpose4(value);
      for (int f = 0; f < F; ++f) store4(encoded + (level * F + f) * ld + quad, value[f]);
    }
}

template <bool kComplete>
SNH_INLINE void add_row(float* grad_features, int32_t place, vec4 grad) {
  if (!kComplete && place < 0) return;
  float* row = grad_features + static_cast<int64_t>(place) * 2;
  store4(row, load4(row) + grad);
}

// Backward of the look-up for W points at column n: from grad_encoded [L * F][ld] to the features (if kScatter) and
// to the points, grad_x [3][ld] (written).
template <bool kComplete, bool kScatter>
SNH_INLINE void points_backward(const SimdField& field, const LookupRows& rows, int n, int64_t ld,
                                const float* grad_encoded, const float* jacobian, float* grad_features,
                                float* grad_x) {
  const int F = field.n_features;
  for (int quad = n; quad < n + W; quad += 4) {
    vec4 along[3][4] = {};
    for (int level = 0; level < field.n_levels; ++level) {
      vec4 grad[4] = {};
      for (int f = 0; f < F; ++f) grad[f] = load4(grad_encoded + (level * F + f) * ld + quad);
      transpose4(grad);
      for (int p = 0; p < 4; ++p) {
        const vec4 g = grad[p], per_metre = g * field.inv_cell[level];
        for (int a = 0; a < 3; ++a, jacobian += 4) along[a][p] += per_metre * load4(jacobian);
        if (!kScatter) continue;
        for (int plane = 0; plane < kPlanes; ++plane) {
          const int cell = level * kPlanes + plane;
          const int32_t* place = rows.place + cell * 4 * ld + quad + p;
          const float u = rows.fraction[cell * 2 * ld + quad + p],
                      v = rows.fraction[(cell * 2 + 1) * ld + quad + p];
          const vec4 g1 = u * g, g0 = g - g1;
          const vec4 g11 = v * g1, g01 = v * g0;
          add_row<kComplete>(grad_features, place[0], g0 - g01);
          add_row<kComplete>(grad_features, place[ld], g1 - g11);
          add_row<kComplete>(grad_features, place[2 * ld], g01);
          add_row<kComplete>(grad_features, place[3 * ld], g11);
        }
      }
    }
    for (int a = 0; a < 3; ++a) {
      transpose4(along[a]);
      store4(grad_x + a * ld + quad, (along[a][0] + along[a][1]) + (along[a][2] + along[a][3]));
    }
  }
}

}  // namespace snh::SNH_SIMD
