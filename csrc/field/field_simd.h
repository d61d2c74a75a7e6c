// What the driver (field_driver_cpu.cpp) hands to the code that is compiled once per instruction set
// (field_simd.cpp): plain pointers and numbers. No function is defined here, so nothing can leak between the sets.
#pragma once

#include <cstdint>

#include "common/lattice.h"

namespace snh {

constexpr int kPanel = 8;       // outputs that one register tile of a layer computes
constexpr int kFeatureRow = 4;  // floats

constexpr int round_up(int n, int multiple) { return (n + multiple - 1) / multiple * multiple; }

// A linear layer, packed: panels of kPanel outputs (padded with zeros), [panel][input][kPanel]. `backward` is the
// same for the transposed matrix.
struct SimdLayer {
  int n_in, n_out;
  const float *forward, *bias, *backward;
};

struct SimdMlp {
  SimdLayer layer[3];
};

// Where the bricks of one level and plane lie in the directory: brick (i, j) at first + (i - i0) * n_j + (j - j0), for
// i - i0 in [0, n_i) and j - j0 in [0, n_j). Place 0 of the directory is an absent brick.
struct BrickGrid {
  int32_t i0, j0, n_i, n_j, first;
};

// The model and the spec, as one call sees them.
struct SimdField {
  int n_levels, n_features, n_octaves, hidden, n_geometry;
  float inv_cell[kMaxLevels], inv_wavelength, truncation, sharpness;
  bool cut_behind;
  const int32_t* probe;
  int64_t capacity;
  const int64_t *brick_keys, *masks;
  int64_t n_bricks;
  const int32_t*
      directory;  // 2 x number + 1 if the brick has all its vertices, or -1; null: ask the hash table
  BrickGrid grids[kMaxLevels * kPlanes];
  const float* features;
  SimdMlp geometry, color;
};

struct SimdRays {
  const float *dirs_c, *depth, *color;
  const int32_t* frame_index;
  const float *T_wc, *uniforms;
};

// The share of one thread of a map step. Gradients are its own; `losses` and `weight_tiles` are added to.
struct SimdMapShare {
  int64_t begin, end;  // rays
  double losses[4];    // sums over its rays
  float* grad_features;
  uint8_t* touched;     // [1 + B]; the first is for absent bricks
  float* grad_T_wc;     // [M, 3, 4]
  float* weight_tiles;  // gradient of the decoder in the order of the register tiles
  float* workspace;
};

struct SimdMap {
  SimdRays rays;
  int n_base, n_surface;
  float near, far, truncation;
  float lambdas[4];  // divided by the number of rays
  bool with_gradients;
};

struct SimdTrack {
  SimdRays rays;
  int n_samples;
  float band;
  float* residuals;
  float* jacobian;
  bool* valid;
};

// One instruction set.
struct SimdSet {
  int64_t (*workspace_floats)(const SimdField& field, int n_samples);
  int64_t (*weight_tile_floats)(const SimdField& field);
  void (*map_rays)(const SimdField& field, const SimdMap& map, SimdMapShare& share);
  // Adds the gradient in `weight_tiles` to the flat decoder's and clears it.
  void (*add_weight_tiles)(const SimdField& field, float* weight_tiles, float* grad_decoder);
  void (*track_rays)(const SimdField& field, const SimdTrack& track, int64_t begin, int64_t end,
                     float* workspace);
  void (*query_points)(const SimdField& field, const float* points, int64_t begin, int64_t end, float* tsdf,
                       float* color, bool* valid, float* workspace);
};

namespace baseline {
extern const SimdSet kSimdSet;
}
namespace avx2 {
extern const SimdSet kSimdSet;
}
namespace avx512 {
extern const SimdSet kSimdSet;
}

}  // namespace snh
