// The fast implementation of field.h: structure of arrays over the points of a block of rays that stays in the
// second-level cache. Compiled once per instruction set; judged by field_cpu.cpp, which has the derivations.
#include "field/field_simd.h"

#include "field/field.h"
#include "field/simd_lookup.h"
#include "field/simd_math.h"
#include "field/simd_mlp.h"

namespace snh::SNH_SIMD {
namespace {

constexpr int kBlockPoints = 192;
constexpr float kWeightEpsilon = 1e-8f;  // as ray_render's

// --- workspace ----------------------------------------------------------------------------------------------------

// The rows of a block, `ld` floats each unless said.
struct Block {
  int64_t ld;
  int n_points, n_padded;               // of the current block, and rounded up to W
  float* z;                             // m
  float* ahead;                         // D - z, m
  float* x;                             // [3] world, m
  float* weight;                        // p of eq. 7
  float* slope;                         // tanh(x / 2): w'(x) = -slope w(x)
  float *free_error, *in_free;          // s - 1, and 1, in free space, else 0
  float *surface_error, *near_surface;  // z + T_r s - D, m, and 1, near the surface, else 0
  float* grad_weight;                   // dL/dp
  float* grad_x;                        // [3]
  float* jacobian;                      // [L * kJacobianFloats]
  float *color_x, *color_grad_x;        // [3] of the active samples, dense
  float* base_z;                        // [2 S] strata before merging
  int32_t* active;                      // columns of the samples whose colour is decoded
  int32_t* active_end;                  // per ray: end of its run in `active`
  bool* valid;                          // all vertices of the look-up exist
  Lookup lookup;
  MlpRows geometry, color;  // color: the active samples only, dense

  float* tsdf() const { return geometry.output; }
  float* grad_tsdf() const { return geometry.grad_output; }
};

// Hands out 64-byte lines of one piece of memory, or counts them.
struct Carver {
  float* memory;
  int64_t used = 0;

  float* floats(int64_t n) {
    float* here = memory ? memory + used : nullptr;
    used += (n + 15) / 16 * 16;
    return here;
  }
  int32_t* ints(int64_t n) { return reinterpret_cast<int32_t*>(floats(n)); }
};

MlpRows carve_mlp(Carver& carver, const SimdMlp& mlp, int64_t ld) {
  const int hidden = round_up(mlp.layer[0].n_out, kPanel);
  const int n_in = round_up(mlp.layer[0].n_in, kPanel), n_out = round_up(mlp.layer[2].n_out, kPanel);
  const auto rows = [&](int n) { return carver.floats(n * ld); };
  return {rows(n_in),  rows(hidden), rows(hidden), rows(n_out),
          rows(n_out), rows(hidden), rows(hidden), rows(n_in)};
}

int block_rays(int n_samples) {
  return n_samples >= kBlockPoints ? 1 : kBlockPoints / (n_samples < 1 ? 1 : n_samples);
}

Block carve(Carver& carver, const SimdField& field, int n_samples) {
  const int n_rays = block_rays(n_samples), n_cells = field.n_levels * kPlanes;
  Block block{};
  // An odd number of lines, so that the same column of many rows does not fall into few cache sets.
  const int64_t ld = block.ld = round_up(n_rays * n_samples + 1, 32) + 16;
  const auto rows = [&](int n) { return carver.floats(n * ld); };
  block.z = rows(1);
  block.ahead = rows(1);
  block.x = rows(3);
  block.weight = rows(1);
  block.slope = rows(1);
  block.free_error = rows(1);
  block.in_free = rows(1);
  block.surface_error = rows(1);
  block.near_surface = rows(1);
  block.grad_weight = rows(1);
  block.grad_x = rows(3);
  block.color_x = rows(3);
  block.color_grad_x = rows(3);
  block.jacobian = rows(field.n_levels * kJacobianFloats);
  block.base_z = carver.floats(2 * n_samples);
  block.valid = reinterpret_cast<bool*>(carver.ints(ld));
  block.active = carver.ints(ld);
  block.active_end = carver.ints(n_rays);
  const int64_t n_pairs = ld * n_cells * 2;
  block.lookup.pair =
      reinterpret_cast<const float**>(carver.floats(n_pairs * sizeof(float*) / sizeof(float)));
  block.lookup.fraction = carver.floats(n_pairs);
  block.lookup.scratch = carver.floats(n_pairs / 2 * kOddFloats);
  block.lookup.odd = reinterpret_cast<OddCell*>(carver.floats(n_pairs / 2 * sizeof(OddCell) / sizeof(float)));
  block.geometry = carve_mlp(carver, field.geometry, ld);
  block.color = carve_mlp(carver, field.color, ld);
  return block;
}

int64_t workspace_floats(const SimdField& field, int n_samples) {
  Carver counter{nullptr};
  carve(counter, field, n_samples);
  return counter.used;
}

Block start(const SimdField& field, int n_samples, float* workspace, uint8_t* touched) {
  Carver carver{workspace};
  Block block = carve(carver, field, n_samples);
  block.lookup.touched = touched ? touched + 1 : nullptr;
  return block;
}

// --- samples ------------------------------------------------------------------------------------------------------

// As ray_sample: the depth of one sample in each of n strata of [low, high].
void stratify(float low, float high, const float* uniforms, int n, float* z) {
  const float step = n ? (high - low) / static_cast<float>(n) : 0.f;
  for (int k = 0; k < n; ++k) z[k] = low + (static_cast<float>(k) + uniforms[k]) * step;
}

void merge(const float* a, int n_a, const float* b, int n_b, float* z) {
  const float *end_a = a + n_a, *end_b = b + n_b;
  while (a < end_a && b < end_b) *z++ = *b < *a ? *b++ : *a++;
  while (a < end_a) *z++ = *a++;
  while (b < end_b) *z++ = *b++;
}

struct Ray {
  const float *dir_c, *T_wc;
  float depth;
};

Ray ray_at(const SimdRays& rays, int64_t r) {
  const int64_t frame = rays.frame_index ? rays.frame_index[r] : 0;
  return {rays.dirs_c + r * 3, rays.T_wc + frame * 16, rays.depth[r]};
}

// World points of the samples block.z[first ...] of a ray: R (z dir_c) + t.
void place_points(const Block& block, const Ray& ray, int first, int n_samples) {
  for (int a = 0; a < 3; ++a) {
    const float* row = ray.T_wc + a * 4;
    const float direction = row[0] * ray.dir_c[0] + row[1] * ray.dir_c[1] + row[2] * ray.dir_c[2];
    float* x = block.x + a * block.ld;
    for (int n = first; n < first + n_samples; ++n) x[n] = row[3] + direction * block.z[n];
  }
  for (int n = first; n < first + n_samples; ++n) block.ahead[n] = ray.depth - block.z[n];
}

// The lanes that fill the last vector repeat the last point: finite if it is, and in bricks that are wanted anyway.
void pad_points(Block& block, int n_points) {
  block.n_points = n_points;
  block.n_padded = round_up(n_points, W);
  for (int n = n_points; n < block.n_padded; ++n) {
    for (int a = 0; a < 3; ++a) block.x[a * block.ld + n] = block.x[a * block.ld + n_points - 1];
    block.z[n] = block.z[n_points - 1];
    block.ahead[n] = block.ahead[n_points - 1];
  }
}

// --- the field at the points of a block (eq. 4 and 5) -------------------------------------------------------------

// Rows of gamma for the W points at column n of x [3].
SNH_INLINE void positional_encoding(const SimdField& field, const float* x, float* gamma, int n, int64_t ld) {
  for (int a = 0; a < 3; ++a) {
    const vec cycles = load(x + a * ld + n) * field.inv_wavelength;
    vec s, c;
    sincos_pi(cycles - round(cycles), s, c);
    float* row = gamma + a * ld + n;
    for (int octave = 0; octave < field.n_octaves; ++octave, row += 6 * ld) {  // each doubles the angle
      const vec twice_s = s + s;
      s = twice_s * c;
      c = c * c * 2.f - 1.f;
      store(row, s);
      store(row + 3 * ld, c);
    }
  }
}

// d sin = k cos dx, d cos = -k sin dx: adds to grad_x [3].
SNH_INLINE void positional_backward(const SimdField& field, const float* gamma, const float* grad_gamma,
                                    float* grad_x, int n, int64_t ld) {
  for (int a = 0; a < 3; ++a) {
    const float *row = gamma + a * ld + n, *grad = grad_gamma + a * ld + n;
    vec total = load(grad_x + a * ld + n);
    float wave_number = 2 * 3.14159265f * field.inv_wavelength;
    for (int octave = 0; octave < field.n_octaves; ++octave, wave_number *= 2, row += 6 * ld, grad += 6 * ld)
      total += wave_number * (load(grad) * load(row + 3 * ld) - load(grad + 3 * ld) * load(row));
    store(grad_x + a * ld + n, total);
  }
}

template <bool kJacobian, bool kValid>
void encode(const SimdField& field, Block& block, bool* valid) {
  const int64_t ld = block.ld, jacobian_floats = static_cast<int64_t>(field.n_levels) * kJacobianFloats;
  float* encoded = block.geometry.input + 6 * field.n_octaves * ld;
  block.lookup.n_odd = 0;
  for (int n = 0; n < block.n_padded; n += W) {
    const vec x[3] = {load(block.x + n), load(block.x + ld + n), load(block.x + 2 * ld + n)};
    const uint32_t missing = find_corners<kValid>(field, block.lookup, x, n / W);
    for (int l = 0; kValid && l < W; ++l) valid[n + l] = !((missing >> l) & 1);
    encode_points<kJacobian>(field, block.lookup, n / W, ld, encoded, block.jacobian + n * jacobian_floats);
    positional_encoding(field, block.x, block.geometry.input, n, ld);
  }
}

// From geometry.grad_input to grad_x and, if kScatter, to the features.
template <bool kScatter>
void encode_backward(const SimdField& field, const Block& block, float* grad_features) {
  const int64_t ld = block.ld, jacobian_floats = static_cast<int64_t>(field.n_levels) * kJacobianFloats;
  const float* grad_encoded = block.geometry.grad_input + 6 * field.n_octaves * ld;
  const int64_t to_gradient =
      reinterpret_cast<intptr_t>(grad_features) - reinterpret_cast<intptr_t>(field.features);
  if (kScatter) prepare_odd_cells(block.lookup, to_gradient);
  for (int n = 0; n < block.n_padded; n += W) {
    points_backward<kScatter>(field, block.lookup, n / W, ld, grad_encoded,
                              block.jacobian + n * jacobian_floats, to_gradient, block.grad_x);
    positional_backward(field, block.geometry.input, block.geometry.grad_input, block.grad_x, n, ld);
  }
  if (kScatter) add_odd_cells(block.lookup, grad_features);
}

// Decodes the colour of n columns, dense in color.output. Their points and rho are copied, padded with zeros, and
// gamma is computed again: cheaper than copying its many rows.
void decode_color(const SimdField& field, const Block& block, const int32_t* columns, int n) {
  const int64_t ld = block.ld;
  const int n_padded = round_up(n, W);
  const auto copy = [&](const float* from, float* to) {
    for (int k = 0; k < n; ++k) to[k] = from[columns[k]];
    for (int k = n; k < n_padded; ++k) to[k] = 0;
  };
  for (int a = 0; a < 3; ++a) copy(block.x + a * ld, block.color_x + a * ld);
  float* rho = block.color.input + 6 * field.n_octaves * ld;
  for (int g = 0; g < field.n_geometry; ++g) copy(block.geometry.output + (1 + g) * ld, rho + g * ld);
  for (int k = 0; k < n_padded; k += W) positional_encoding(field, block.color_x, block.color.input, k, ld);
  mlp_forward(field.color, block.color, n_padded, ld);
  for (int channel = 0; channel < 3; ++channel)
    for (int k = 0; k < n_padded; k += W) {
      float* color = block.color.output + channel * ld + k;
      store(color, 1.f / (1.f + exp(min(-load(color), splat(87.f)))));
    }
}

// --- rendering and losses (eq. 6-10) ------------------------------------------------------------------------------

SNH_INLINE float row_sum(const float* a, int n) {
  vec total{};
  int k = 0;
  for (; k + W <= n; k += W) total += load(a + k);
  float result = sum(total);
  for (; k < n; ++k) result += a[k];
  return result;
}

SNH_INLINE float row_dot(const float* a, const float* b, int n) {
  vec total{};
  int k = 0;
  for (; k + W <= n; k += W) total += load(a + k) * load(b + k);
  float result = sum(total);
  for (; k < n; ++k) result += a[k] * b[k];
  return result;
}

// What each sample contributes, before anything is summed along its ray.
void judge_samples(const SimdField& field, const Block& block) {
  const float T_r = field.truncation;
  for (int n = 0; n < block.n_padded; n += W) {
    const vec s = load(block.tsdf() + n), ahead = load(block.ahead + n);
    const vec x = s * field.sharpness, e = exp(-abs(x)), inverse = 1.f / (1.f + e);
    const vec slope = (1.f - e) * inverse;
    store(block.weight + n, e * inverse * inverse);
    store(block.slope + n, x < 0.f ? -slope : slope);
    const veci is_free = ahead > T_r, is_near = abs(ahead) <= T_r;
    store(block.free_error + n, is_free ? s - 1.f : vec{});
    store(block.in_free + n, is_free ? splat(1.f) : vec{});
    store(block.surface_error + n, is_near ? T_r * s - ahead : vec{});
    store(block.near_surface + n, is_near ? splat(1.f) : vec{});
  }
}

// Samples deeper than the truncation behind the first crossing lose their weight (ray_render's cut).
void cut_behind(const SimdField& field, const Block& block, int first, int n_samples) {
  const float* s = block.tsdf() + first;
  const float* z = block.z + first;
  int k = 0;
  while (k + 1 < n_samples && !(s[k] > 0 && s[k + 1] <= 0)) ++k;
  if (k + 1 >= n_samples) return;
  const float deepest = z[k] + field.truncation;
  for (int n = k; n < n_samples; ++n)
    if (z[n] > deepest) block.weight[first + n] = 0;
}

struct RaySums {
  float depth_error, color_error[3];
  float free_share, surface_share;  // 1 / number of samples in free space, near the surface
};

// Normalises the weights of a ray; losses 1 to 3.
RaySums judge_ray(const SimdField& field, const Block& block, float depth, int first, int n_samples,
                  double losses[4]) {
  if (field.cut_behind) cut_behind(field, block, first, n_samples);
  float* weight = block.weight + first;
  const float share = 1.f / (row_sum(weight, n_samples) + kWeightEpsilon);
  for (int n = 0; n < n_samples; ++n) weight[n] *= share;

  RaySums ray{};
  ray.depth_error = row_dot(weight, block.z + first, n_samples) - depth;
  const float n_free = row_sum(block.in_free + first, n_samples);
  const float n_surface = row_sum(block.near_surface + first, n_samples);
  ray.free_share = n_free > 0 ? 1 / n_free : 1;
  ray.surface_share = n_surface > 0 ? 1 / n_surface : 1;
  losses[1] += static_cast<double>(ray.depth_error * ray.depth_error);
  const float *free_error = block.free_error + first, *surface_error = block.surface_error + first;
  losses[2] += static_cast<double>(row_dot(free_error, free_error, n_samples) * ray.free_share);
  losses[3] += static_cast<double>(row_dot(surface_error, surface_error, n_samples) * ray.surface_share);
  return ray;
}

// Loss 0 of a ray from its active samples [begin, end).
void judge_color(const Block& block, const float* color, int begin, int end, RaySums& ray, double losses[4]) {
  double sum_of_squares = 0;
  for (int channel = 0; channel < 3; ++channel) {
    float rendered = 0;
    for (int k = begin; k < end; ++k)
      rendered += block.weight[block.active[k]] * block.color.output[channel * block.ld + k];
    ray.color_error[channel] = rendered - color[channel];
    sum_of_squares += static_cast<double>(ray.color_error[channel] * ray.color_error[channel]);
  }
  losses[0] += sum_of_squares / 3;
}

// Gradients of a ray to its tsdf and to the colours of its active samples before the sigmoid.
void ray_backward(const SimdField& field, const SimdMap& map, const Block& block, const float* color,
                  float depth, const RaySums& ray, int first, int n_samples, int begin, int end) {
  const float* weight = block.weight;
  const float grad_depth = 2 * map.lambdas[1] * ray.depth_error;
  float mean = grad_depth * (ray.depth_error + depth);  // sum_i p_i g_i
  for (int n = first; n < first + n_samples; ++n) block.grad_weight[n] = grad_depth * block.z[n];
  for (int channel = 0; channel < 3; ++channel) {
    const float grad = map.lambdas[0] * (2.f / 3.f) * ray.color_error[channel];
    const float* c = block.color.output + channel * block.ld;
    float* grad_c = block.color.grad_output + channel * block.ld;
    mean += grad * (ray.color_error[channel] + color[channel]);
    for (int k = begin; k < end; ++k) {
      const int n = block.active[k];
      block.grad_weight[n] += grad * c[k];
      grad_c[k] = grad * weight[n] * c[k] * (1 - c[k]);
    }
  }
  const float free_factor = 2 * map.lambdas[2] * ray.free_share;
  const float surface_factor = 2 * map.lambdas[3] * ray.surface_share * field.truncation;
  float* grad_tsdf = block.grad_tsdf();
#pragma GCC ivdep
  for (int n = first; n < first + n_samples; ++n)
    grad_tsdf[n] = free_factor * block.free_error[n] + surface_factor * block.surface_error[n] -
                   field.sharpness * block.slope[n] * weight[n] * (block.grad_weight[n] - mean);
}

// --- the map form -------------------------------------------------------------------------------------------------

void sample_rays(const SimdMap& map, Block& block, int64_t first_ray, int n_rays) {
  const int S = map.n_base + map.n_surface;
  for (int r = 0; r < n_rays; ++r) {
    const Ray ray = ray_at(map.rays, first_ray + r);
    const float* uniforms = map.rays.uniforms + (first_ray + r) * S;
    stratify(map.near * ray.depth, map.far * ray.depth, uniforms, map.n_base, block.base_z);
    stratify(ray.depth - map.truncation, ray.depth + map.truncation, uniforms + map.n_base, map.n_surface,
             block.base_z + map.n_base);
    merge(block.base_z, map.n_base, block.base_z + map.n_base, map.n_surface, block.z + r * S);
    place_points(block, ray, r * S, S);
  }
  pad_points(block, n_rays * S);
}

// Lists the samples whose weight can matter; the runs of the rays follow each other.
void find_active(const Block& block, int n_rays, int n_samples) {
  int count = 0, n = 0;
  for (int r = 0; r < n_rays; ++r) {
    for (const int end = n + n_samples; n < end; ++n) {
      block.active[count] = n;
      count += block.weight[n] >= static_cast<float>(kColorWeight);
    }
    block.active_end[r] = count;
  }
}

// From the gradients of the active colours to the colour decoder, to rho (geometry.grad_output) and to the points of the
// active samples (color_grad_x).
void color_backward(const SimdField& field, const Block& block, int n_active, float* weight_tiles) {
  const int64_t ld = block.ld;
  const int n_gamma = 6 * field.n_octaves, n_padded = round_up(n_active, W);
  for (int row = 0; row < kTileOutputs; ++row)
    for (int k = row < 3 ? n_active : 0; k < n_padded; ++k) block.color.grad_output[row * ld + k] = 0;
  mlp_backward(field.color, block.color, 3, n_padded, ld);
  mlp_weight_gradients(field.color, block.color, weight_tiles, n_padded, ld);

  for (int row = 1; row < round_up(1 + field.n_geometry, kTileOutputs); ++row) {
    float* grad = block.geometry.grad_output + row * ld;
    for (int n = 0; n < block.n_padded; n += W) store(grad + n, vec{});
    const float* from = block.color.grad_input + (n_gamma + row - 1) * ld;
    for (int k = 0; k < n_active && row <= field.n_geometry; ++k) grad[block.active[k]] = from[k];
  }
  for (int k = 0; k < n_padded; k += W) {
    for (int a = 0; a < 3; ++a) store(block.color_grad_x + a * ld + k, vec{});
    positional_backward(field, block.color.input, block.color.grad_input, block.color_grad_x, k, ld);
  }
}

void add_color_gradient(const Block& block, int n_active) {
  for (int a = 0; a < 3; ++a)
    for (int k = 0; k < n_active; ++k)
      block.grad_x[a * block.ld + block.active[k]] += block.color_grad_x[a * block.ld + k];
}

// p_w = R (z dir_c) + t.
void pose_gradients(const SimdMap& map, const Block& block, int64_t first_ray, int n_rays, float* grad_T_wc) {
  const int S = map.n_base + map.n_surface;
  for (int r = 0; r < n_rays; ++r) {
    const float* dir_c = map.rays.dirs_c + (first_ray + r) * 3;
    float* grad = grad_T_wc + static_cast<int64_t>(map.rays.frame_index[first_ray + r]) * 12;
    for (int a = 0; a < 3; ++a, grad += 4) {
      const float* grad_x = block.grad_x + a * block.ld + r * S;
      const float along_ray = row_dot(grad_x, block.z + r * S, S);
      for (int b = 0; b < 3; ++b) grad[b] += along_ray * dir_c[b];
      grad[3] += row_sum(grad_x, S);
    }
  }
}

void map_block(const SimdField& field, const SimdMap& map, SimdMapShare& share, Block& block,
               int64_t first_ray, int n_rays, RaySums* sums) {
  const int S = map.n_base + map.n_surface;
  sample_rays(map, block, first_ray, n_rays);
  if (map.with_gradients)
    encode<true, false>(field, block, nullptr);
  else
    encode<false, false>(field, block, nullptr);
  mlp_forward(field.geometry, block.geometry, block.n_padded, block.ld);

  judge_samples(field, block);
  for (int r = 0; r < n_rays; ++r)
    sums[r] = judge_ray(field, block, map.rays.depth[first_ray + r], r * S, S, share.losses);
  find_active(block, n_rays, S);
  const int n_active = block.active_end[n_rays - 1];
  decode_color(field, block, block.active, n_active);
  for (int r = 0, begin = 0; r < n_rays; begin = block.active_end[r++])
    judge_color(block, map.rays.color + (first_ray + r) * 3, begin, block.active_end[r], sums[r],
                share.losses);
  if (!map.with_gradients) return;

  for (int r = 0, begin = 0; r < n_rays; begin = block.active_end[r++])
    ray_backward(field, map, block, map.rays.color + (first_ray + r) * 3, map.rays.depth[first_ray + r],
                 sums[r], r * S, S, begin, block.active_end[r]);
  for (int n = block.n_points; n < block.n_padded; ++n) block.grad_tsdf()[n] = 0;
  color_backward(field, block, n_active, share.weight_tiles + mlp_tile_floats(field.geometry));
  mlp_backward(field.geometry, block.geometry, 1 + field.n_geometry, block.n_padded, block.ld);
  mlp_weight_gradients(field.geometry, block.geometry, share.weight_tiles, block.n_padded, block.ld);
  encode_backward<true>(field, block, share.grad_features);
  add_color_gradient(block, n_active);
  pose_gradients(map, block, first_ray, n_rays, share.grad_T_wc);
}

void map_rays(const SimdField& field, const SimdMap& map, SimdMapShare& share) {
  const int S = map.n_base + map.n_surface, n_rays = block_rays(S);
  Block block = start(field, S, share.workspace, share.touched);
  RaySums sums[kBlockPoints];
  for (int64_t r = share.begin; r < share.end; r += n_rays) {
    const int64_t rest = share.end - r;
    map_block(field, map, share, block, r, rest < n_rays ? static_cast<int>(rest) : n_rays, sums);
  }
}

int64_t weight_tile_floats(const SimdField& field) {
  return mlp_tile_floats(field.geometry) + mlp_tile_floats(field.color);
}

void add_weight_tiles(const SimdField& field, float* weight_tiles, float* grad_decoder) {
  unpack_tiles(field.geometry, weight_tiles, grad_decoder);
  unpack_tiles(field.color, weight_tiles, grad_decoder);
}

// --- the track form -----------------------------------------------------------------------------------------------

// Residuals, Jacobian and validity of one ray, from tsdf and its gradient in grad_x.
void write_track(const SimdField& field, const SimdTrack& track, const Block& block, const Ray& ray,
                 int first, int64_t out) {
  for (int n = first; n < first + track.n_samples; ++n, ++out) {
    track.residuals[out] = field.truncation * block.tsdf()[n] - block.ahead[n];
    track.valid[out] = block.valid[n];
    float h[3], p[3];  // T_r R^T ds/dp_w and the point, camera frame
    for (int a = 0; a < 3; ++a) {
      h[a] = 0;
      for (int b = 0; b < 3; ++b) h[a] += ray.T_wc[b * 4 + a] * block.grad_x[b * block.ld + n];
      h[a] *= field.truncation;
      p[a] = block.z[n] * ray.dir_c[a];
    }
    float* row = track.jacobian + out * 6;
    for (int a = 0; a < 3; ++a) row[a] = h[a];
    row[3] = p[1] * h[2] - p[2] * h[1];
    row[4] = p[2] * h[0] - p[0] * h[2];
    row[5] = p[0] * h[1] - p[1] * h[0];
  }
}

void track_block(const SimdField& field, const SimdTrack& track, Block& block, int64_t first_ray,
                 int n_rays) {
  const int S = track.n_samples;
  for (int r = 0; r < n_rays; ++r) {
    const Ray ray = ray_at(track.rays, first_ray + r);
    stratify(ray.depth - track.band, ray.depth + track.band, track.rays.uniforms + (first_ray + r) * S, S,
             block.z + r * S);
    place_points(block, ray, r * S, S);
  }
  pad_points(block, n_rays * S);
  encode<true, true>(field, block, block.valid);
  mlp_forward(field.geometry, block.geometry, block.n_padded, block.ld);
  for (int n = 0; n < block.n_padded; n += W) store(block.grad_tsdf() + n, splat(1.f));
  mlp_backward(field.geometry, block.geometry, 1, block.n_padded, block.ld);
  encode_backward<false>(field, block, nullptr);
  for (int r = 0; r < n_rays; ++r)
    write_track(field, track, block, ray_at(track.rays, first_ray + r), r * S, (first_ray + r) * S);
}

void track_rays(const SimdField& field, const SimdTrack& track, int64_t begin, int64_t end,
                float* workspace) {
  const int n_rays = block_rays(track.n_samples);
  Block block = start(field, track.n_samples, workspace, nullptr);
  for (int64_t r = begin; r < end; r += n_rays)
    track_block(field, track, block, r, end - r < n_rays ? static_cast<int>(end - r) : n_rays);
}

// --- the query form -----------------------------------------------------------------------------------------------

void query_block(const SimdField& field, Block& block, const float* points, int n, float* tsdf, float* color,
                 bool* valid) {
  for (int k = 0; k < n; ++k) {
    for (int a = 0; a < 3; ++a) block.x[a * block.ld + k] = points[k * 3 + a];
    block.active[k] = k;
  }
  pad_points(block, n);
  encode<false, true>(field, block, block.valid);
  mlp_forward(field.geometry, block.geometry, block.n_padded, block.ld);
  for (int k = 0; k < n; ++k) {
    tsdf[k] = block.tsdf()[k];
    valid[k] = block.valid[k];
  }
  if (!color) return;
  decode_color(field, block, block.active, n);
  for (int k = 0; k < n; ++k)
    for (int channel = 0; channel < 3; ++channel)
      color[k * 3 + channel] = block.color.output[channel * block.ld + k];
}

void query_points(const SimdField& field, const float* points, int64_t begin, int64_t end, float* tsdf,
                  float* color, bool* valid, float* workspace) {
  Block block = start(field, 1, workspace, nullptr);
  for (int64_t n = begin; n < end; n += kBlockPoints) {
    const int count = end - n < kBlockPoints ? static_cast<int>(end - n) : kBlockPoints;
    query_block(field, block, points + n * 3, count, tsdf + n, color ? color + n * 3 : nullptr, valid + n);
  }
}

}  // namespace

extern const SimdSet kSimdSet = {workspace_floats, weight_tile_floats, map_rays,
                                 add_weight_tiles, track_rays,         query_points};

}  // namespace snh::SNH_SIMD
