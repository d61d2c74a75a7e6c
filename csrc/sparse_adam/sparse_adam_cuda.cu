// sparse_adam: one thread per vertex, 64 to a brick, 16 bytes of each array a thread. Bricks that were not touched
// cost one byte.
#include <cmath>

#include "common/kernel.cuh"
#include "common/key.h"
#include "sparse_adam/sparse_adam.h"

namespace snh::cuda {
namespace {

constexpr int kBricks = 4;  // per block
constexpr int kThreads = 256;

// The constants of a step, in double on the host as the CPU has them.
struct Rule {
  float beta1, beta2, step_size, root, eps;

  explicit Rule(const AdamStep& adam)
      : beta1(static_cast<float>(adam.beta1)),
        beta2(static_cast<float>(adam.beta2)),
        step_size(static_cast<float>(adam.lr / (1 - std::pow(adam.beta1, static_cast<double>(adam.step))))),
        root(static_cast<float>(1 / std::sqrt(1 - std::pow(adam.beta2, static_cast<double>(adam.step))))),
        eps(static_cast<float>(adam.eps)) {}

  __device__ void update(float& parameter, float gradient, float& m, float& v) const {
    m = beta1 * m + (1 - beta1) * gradient;
    v = beta2 * v + (1 - beta2) * (gradient * gradient);
    parameter -= step_size * m / (sqrtf(v) * root + eps);
  }
};

// Block (64, kBricks): threadIdx.x = vertex in its brick.
__global__ void __launch_bounds__(kBrickVertices* kBricks)
    sparse_adam_kernel(float4* features, float4* grad_features, float4* m, float4* v, int32_t* last_step,
                       uint8_t* touched, const int64_t* masks, int64_t n_bricks, Rule rule, double beta1,
                       double beta2, int64_t step) {
  SNH_SHARED(float2, decay, kBricks);  // of m and v over the steps that a brick was left out
  const int64_t b = static_cast<int64_t>(blockIdx.x) * kBricks + threadIdx.y;
  const bool active = b < n_bricks && touched[b];
  if (active && threadIdx.x == 0) {
    const double skipped = static_cast<double>(step - 1 - last_step[b]);
    decay[threadIdx.y] = skipped > 0 ? make_float2(static_cast<float>(pow(beta1, skipped)),
                                                   static_cast<float>(pow(beta2, skipped)))
                                     : make_float2(1, 1);
  }
  __syncthreads();  // also: touched and last_step have been read
  if (!active) return;

  const int64_t row = b * kBrickVertices + threadIdx.x;
  const bool exists = masks[b] >> threadIdx.x & 1;
  const float4 g = exists ? grad_features[row] : zero4();
  float4 f = features[row], m_row = m[row], v_row = v[row];
  const float2 by = decay[threadIdx.y];
  m_row = make_float4(m_row.x * by.x, m_row.y * by.x, m_row.z * by.x, m_row.w * by.x);
  v_row = make_float4(v_row.x * by.y, v_row.y * by.y, v_row.z * by.y, v_row.w * by.y);
  rule.update(f.x, g.x, m_row.x, v_row.x);
  rule.update(f.y, g.y, m_row.y, v_row.y);
  rule.update(f.z, g.z, m_row.z, v_row.z);
  rule.update(f.w, g.w, m_row.w, v_row.w);
  features[row] = f, m[row] = m_row, v[row] = v_row;
  grad_features[row] = zero4();
  if (threadIdx.x != 0) return;
  last_step[b] = static_cast<int32_t>(step);
  touched[b] = 0;
}

__global__ void __launch_bounds__(kThreads)
    adam_kernel(float* parameters, const float* gradients, float* m, float* v, int64_t n, Rule rule) {
  const int64_t k = global_thread();
  if (k >= n) return;
  rule.update(parameters[k], gradients[k], m[k], v[k]);
}

}  // namespace

void sparse_adam(float* features, float* grad_features, float* m, float* v, int32_t* last_step,
                 uint8_t* touched, const int64_t* masks, int64_t n_bricks, const AdamStep& adam,
                 Stream stream) {
  if (n_bricks == 0) return;
  const auto rows = [](float* floats) { return reinterpret_cast<float4*>(floats); };
  SNH_LAUNCH(sparse_adam_kernel, blocks_for(n_bricks, kBricks), dim3(kBrickVertices, kBricks), 0, stream,
             rows(features), rows(grad_features), rows(m), rows(v), last_step, touched, masks, n_bricks,
             Rule(adam), adam.beta1, adam.beta2, adam.step);
}

void adam(float* parameters, const float* gradients, float* m, float* v, int64_t n, const AdamStep& adam,
          Stream stream) {
  if (n == 0) return;
  SNH_LAUNCH(adam_kernel, blocks_for(n, kThreads), kThreads, 0, stream, parameters, gradients, m, v, n,
             Rule(adam));
}

}  // namespace snh::cuda
