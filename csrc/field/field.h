// field: the whole scene model in one pass (paper, sections III-A to III-D). A sample p_c on a ray goes to the world,
// is encoded (eq. 4 and gamma), decoded (eq. 5), rendered (eq. 6-7) and judged (eq. 8-10), and the gradients of all
// that go back to features, decoder and poses. Three forms:
//
//   map    losses of rays of many frames, with the gradients that mapping needs
//   track  signed distances near the surface of one frame, with their Jacobian to its pose
//   query  tsdf and colour at points
//
// The model (FieldModel)
//   probe, brick_keys, masks   the hash table (common/key.h), B bricks
//   features  [B*64, 4]        row = slot; columns beyond n_features and rows of absent vertices are zero
//   decoder   [P]              f_g then f_c, each W1 b1 W2 b2 W3 b3 with W [outputs, inputs] row-major:
//                              f_g: [gamma, features] -> hidden -> hidden -> [tsdf, rho]
//                              f_c: [gamma, rho]      -> hidden -> hidden -> rgb through a sigmoid; ReLU between
//
// Encoding of a point x, metres: gamma(x) = for octave o sin(2 pi x / lambda_o) [3], cos(2 pi x / lambda_o) [3] with
// lambda_o = base_wavelength / 2^o, then per level the sum over the planes of the bilinearly interpolated feature.
// A corner without vertex counts as zero; a point is valid if all its corners on all planes and levels exist.
//
// Samples: ray_sample's, n_base strata on [near, far] x depth and n_surface on depth +- truncation (track: n_samples
// strata on depth +- band). Their depths z are constants; p_w = R (z dir_c) + t carries the gradient to T_wc.
//
// Rendering: ray_render's, p_i = w_i / (sum_j w_j + 1e-8), w = sigmoid(s sharpness) sigmoid(-s sharpness), with
// cut_behind without the samples deeper than the truncation behind the first crossing s_k > 0 >= s_{k+1}.
//
// Losses [4], unweighted, means over all R rays (0 if there are none):
//   color   mean over channels of (C^ - C)^2          depth   (D^ - D)^2, m^2
//   fs      mean over a ray's samples with D - z > T_r of (s - 1)^2; 0 for a ray without such samples
//   surface mean over a ray's samples with |D - z| <= T_r of (z + T_r s - D)^2, m^2; 0 for a ray without
//
// Gradients are of the sum of lambda_k loss_k. A gradient to an absent vertex is dropped.
//
// The plain implementation (field_cpu.cpp) decodes the colour of every sample. The fast one (field_simd.cpp) leaves
// out samples with p_i < kColorWeight, which changes a rendered colour by less than S * kColorWeight.
#pragma once

#include <cstdint>

#include "common/lattice.h"

namespace snh {

constexpr int kFeatureStride = 4;  // floats per feature row
constexpr double kColorWeight = 1e-6;

struct FieldSpec {
  int n_levels, n_features, n_octaves, hidden, n_geometry;
  double cell_sizes[kMaxLevels];  // m
  double base_wavelength;         // m
  double truncation;              // m
  double sharpness;               // 1 / truncation units
  bool cut_behind;

  int n_gamma() const { return 6 * n_octaves; }
  int n_encoding() const { return n_gamma() + n_levels * n_features; }
  static int64_t mlp_size(int n_in, int hidden, int n_out) {
    return int64_t(hidden) * (n_in + 1) + int64_t(hidden) * (hidden + 1) + int64_t(n_out) * (hidden + 1);
  }
  int64_t geometry_size() const { return mlp_size(n_encoding(), hidden, 1 + n_geometry); }
  int64_t decoder_size() const { return geometry_size() + mlp_size(n_gamma() + n_geometry, hidden, 3); }
};

template <typename T>
struct FieldModel {
  const int32_t* probe;  // [capacity], a power of two or 0
  int64_t capacity;
  const int64_t* brick_keys;  // [B]
  const int64_t* masks;       // [B]
  int64_t n_bricks;
  const T* features;  // [B*64, 4]
  const T* decoder;   // [P]
};

template <typename T>
struct FieldRays {
  const T* dirs_c;             // [R, 3], z = 1, camera frame
  const T* depth;              // [R] m, > 0
  const T* color;              // [R, 3] in 0..1 (map only)
  const int32_t* frame_index;  // [R] row of T_wc (map only; null: all 0)
  const T* T_wc;               // [M, 4, 4] row-major
  const T* uniforms;           // [R, S] in [0, 1)
  int64_t n_rays, n_frames;
};

struct FieldSampling {
  int n_base, n_surface;
  double near, far;  // x depth
};

// Where the gradients go; `features` null: losses alone.
template <typename T>
struct FieldGradients {
  T* features;       // [B*64, 4], added to
  uint8_t* touched;  // [B], set to 1 for bricks that received a gradient
  T* decoder;        // [P], written
  T* T_wc;           // [M, 3, 4], written
};

namespace cpu {

template <typename T>
void field_map(const FieldSpec& spec, const FieldModel<T>& model, const FieldRays<T>& rays,
               const FieldSampling& sampling, const T lambdas[4], const FieldGradients<T>& gradients,
               T losses[4]);

// residuals [R, S] = z + T_r s - D, m; jacobian [R, S, 6] to the right twist (rho, phi) of T_wc, T exp(twist):
// with h = T_r R^T ds/dp_w, d residual = h . rho + (p_c x h) . phi; valid [R, S].
template <typename T>
void field_track(const FieldSpec& spec, const FieldModel<T>& model, const FieldRays<T>& rays, int n_samples,
                 T band, T* residuals, T* jacobian, bool* valid);

// points [N, 3] m; tsdf [N]; color [N, 3] or null; valid [N].
template <typename T>
void field_query(const FieldSpec& spec, const FieldModel<T>& model, const T* points, int64_t n_points,
                 T* tsdf, T* color, bool* valid);

}  // namespace cpu
}  // namespace snh
