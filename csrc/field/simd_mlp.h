// Decoders on a block of points. Activations are rows of `ld` floats, one row per unit, one column per point; a
// register tile is kPanel units x kTile vectors of points, so that each weight is loaded once per tile.
#pragma once

#include "field/field_simd.h"
#include "field/simd_math.h"

namespace snh::SNH_SIMD {

constexpr int kTile = W == 16 ? 2 : 1;  // 16 accumulators of the 32 (AVX-512) or 8 of the 16 registers

enum class Epilogue { none, relu, relu_backward };

// out[o][n] = bias[o] + sum_k panels[o][k] in[k][n] for all outputs (rounded up to kPanel) and T vectors of points;
// k runs over the first n_in of the `n_columns` columns.
// relu_backward keeps the result where `activation` [o][n] is positive.
template <int T, Epilogue kEpilogue>
SNH_INLINE void multiply_tile(const float* panels, int n_columns, const float* bias, int n_in, int n_out,
                              const float* in, float* out, const float* activation, int64_t ld) {
  for (int o = 0; o < n_out; o += kPanel) {
    vec sum[kPanel][T];
    for (int u = 0; u < kPanel; ++u)
      for (int t = 0; t < T; ++t) sum[u][t] = bias ? splat(bias[o + u]) : vec{};
    const float *x = in, *w = panels + static_cast<int64_t>(o) * n_columns;
    for (int k = 0; k < n_in; ++k, x += ld, w += kPanel) {
      vec column[T];
      for (int t = 0; t < T; ++t) column[t] = load(x + t * W);
#pragma GCC unroll 8
      for (int u = 0; u < kPanel; ++u)
        for (int t = 0; t < T; ++t) sum[u][t] += w[u] * column[t];
    }
    for (int u = 0; u < kPanel; ++u)
      for (int t = 0; t < T; ++t) {
        const int64_t at = (o + u) * ld + t * W;
        vec y = sum[u][t];
        if (kEpilogue == Epilogue::relu) y = max(y, vec{});
        if (kEpilogue == Epilogue::relu_backward) y = load(activation + at) > 0.f ? y : vec{};
        store(out + at, y);
      }
  }
}

// The rows of one decoder.
struct MlpRows {
  float *input, *hidden1, *hidden2, *output;
  float *grad_output, *grad2, *grad1, *grad_input;
};

template <int T>
SNH_INLINE void forward_tile(const SimdMlp& mlp, const MlpRows& rows, int n, int64_t ld) {
  const SimdLayer *a = &mlp.layer[0], *b = &mlp.layer[1], *c = &mlp.layer[2];
  multiply_tile<T, Epilogue::relu>(a->forward, a->n_in, a->bias, a->n_in, a->n_out, rows.input + n,
                                   rows.hidden1 + n, nullptr, ld);
  multiply_tile<T, Epilogue::relu>(b->forward, b->n_in, b->bias, b->n_in, b->n_out, rows.hidden1 + n,
                                   rows.hidden2 + n, nullptr, ld);
  multiply_tile<T, Epilogue::none>(c->forward, c->n_in, c->bias, c->n_in, c->n_out, rows.hidden2 + n,
                                   rows.output + n, nullptr, ld);
}

// From grad_output (its first n_out rows) to grad_input.
template <int T>
SNH_INLINE void backward_tile(const SimdMlp& mlp, const MlpRows& rows, int n_out, int n, int64_t ld) {
  const SimdLayer *a = &mlp.layer[0], *b = &mlp.layer[1], *c = &mlp.layer[2];
  multiply_tile<T, Epilogue::relu_backward>(c->backward, c->n_out, nullptr, n_out, c->n_in,
                                            rows.grad_output + n, rows.grad2 + n, rows.hidden2 + n, ld);
  multiply_tile<T, Epilogue::relu_backward>(b->backward, b->n_out, nullptr, b->n_out, b->n_in, rows.grad2 + n,
                                            rows.grad1 + n, rows.hidden1 + n, ld);
  multiply_tile<T, Epilogue::none>(a->backward, a->n_out, nullptr, a->n_out, a->n_in, rows.grad1 + n,
                                   rows.grad_input + n, nullptr, ld);
}

// n_points is a multiple of W.
inline void mlp_forward(const SimdMlp& mlp, const MlpRows& rows, int n_points, int64_t ld) {
  int n = 0;
  for (; n + kTile * W <= n_points; n += kTile * W) forward_tile<kTile>(mlp, rows, n, ld);
  for (; n < n_points; n += W) forward_tile<1>(mlp, rows, n, ld);
}

// n_out: rows of grad_output that are not zero, the first ones.
inline void mlp_backward(const SimdMlp& mlp, const MlpRows& rows, int n_out, int n_points, int64_t ld) {
  int n = 0;
  for (; n + kTile * W <= n_points; n += kTile * W) backward_tile<kTile>(mlp, rows, n_out, n, ld);
  for (; n < n_points; n += W) backward_tile<1>(mlp, rows, n_out, n, ld);
}

// --- gradients of the weights: outer products, summed over the points of a block ----------------------------------

// A tile is 4 outputs x kTileInputs inputs, W sums, kept in this order in `weight_tiles` over all blocks; after the
// tiles of a layer come its round_up(n_out, W) biases.
constexpr int kTileOutputs = 4, kTileInputs = W / 4;

SNH_INLINE int64_t layer_tile_floats(const SimdLayer& layer) {
  return static_cast<int64_t>(round_up(layer.n_out, kTileOutputs)) * round_up(layer.n_in, kTileInputs) +
         round_up(layer.n_out, W);
}

SNH_INLINE int64_t mlp_tile_floats(const SimdMlp& mlp) {
  return layer_tile_floats(mlp.layer[0]) + layer_tile_floats(mlp.layer[1]) + layer_tile_floats(mlp.layer[2]);
}

// tiles += grad [n_out, N] input [n_in, N]^T and their row sums. Rows beyond n_out and n_in are read to a multiple of 4.
inline float* add_outer_products(const SimdLayer& layer, const float* grad, const float* input, float* tiles,
                                 int n_points, int64_t ld) {
  for (int o = 0; o < layer.n_out; o += kTileOutputs)
    for (int k = 0; k < layer.n_in; k += kTileInputs, tiles += W) {
      vec sum[W] = {};
      const float *g = grad + o * ld, *x = input + k * ld;
      for (int n = 0; n < n_points; n += W, g += W, x += W) {
        vec column[kTileInputs];
        for (int b = 0; b < kTileInputs; ++b) column[b] = load(x + b * ld);
        for (int a = 0; a < kTileOutputs; ++a) {
          const vec row = load(g + a * ld);
          for (int b = 0; b < kTileInputs; ++b) sum[a * kTileInputs + b] += row * column[b];
        }
      }
      store(tiles, load(tiles) + sums(sum));
    }
  for (int o = 0; o < layer.n_out; o += W, tiles += W) {
    vec sum[W] = {};
    for (int a = 0; a < W && o + a < layer.n_out; ++a)
      for (int n = 0; n < n_points; n += W) sum[a] += load(grad + (o + a) * ld + n);
    store(tiles, load(tiles) + sums(sum));
  }
  return tiles;
}

inline float* mlp_weight_gradients(const SimdMlp& mlp, const MlpRows& rows, float* tiles, int n_points,
                                   int64_t ld) {
  tiles = add_outer_products(mlp.layer[0], rows.grad1, rows.input, tiles, n_points, ld);
  tiles = add_outer_products(mlp.layer[1], rows.grad2, rows.hidden1, tiles, n_points, ld);
  return add_outer_products(mlp.layer[2], rows.grad_output, rows.hidden2, tiles, n_points, ld);
}

// Moves the tiles of one decoder to its place in the flat gradient: added there, cleared here.
inline void unpack_tiles(const SimdMlp& mlp, float*& tiles, float*& flat) {
  for (const SimdLayer& layer : mlp.layer) {
    for (int o = 0; o < layer.n_out; o += kTileOutputs)
      for (int k = 0; k < layer.n_in; k += kTileInputs, tiles += W)
        for (int a = 0; a < kTileOutputs; ++a)
          for (int b = 0; b < kTileInputs; ++b) {
            float& sum = tiles[a * kTileInputs + b];
            if (o + a < layer.n_out && k + b < layer.n_in) flat[(o + a) * layer.n_in + k + b] += sum;
            sum = 0;
          }
    flat += layer.n_out * layer.n_in;
    for (int o = 0; o < layer.n_out; ++o) {
      flat[o] += tiles[o];
      tiles[o] = 0;
    }
    flat += layer.n_out;
    tiles += round_up(layer.n_out, W);
  }
}

}  // namespace snh::SNH_SIMD
