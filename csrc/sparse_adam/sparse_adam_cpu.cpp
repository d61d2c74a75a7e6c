#include "sparse_adam/sparse_adam.h"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>

#include "common/key.h"

namespace snh::cpu {
namespace {

constexpr int kRow = 4;  // floats per feature row
constexpr int kBrickFloats = kBrickVertices * kRow;

template <typename T>
using Block = Eigen::Map<Eigen::Array<T, Eigen::Dynamic, 1>>;

// Kingma and Ba, algorithm 1, with the bias corrections folded into step size and denominator as torch has them.
template <typename T>
void update(Block<T> parameters, Block<T> gradients, Block<T> m, Block<T> v, const AdamStep& adam) {
  const T beta1 = T(adam.beta1), beta2 = T(adam.beta2);
  const T step_size = T(adam.lr / (1 - std::pow(adam.beta1, adam.step)));
  const T root = T(1 / std::sqrt(1 - std::pow(adam.beta2, adam.step)));
  m = beta1 * m + (1 - beta1) * gradients;
  v = beta2 * v + (1 - beta2) * gradients.square();
  parameters -= step_size * m / (v.sqrt() * root + T(adam.eps));
}

template <typename T>
void drop_absent(T* grad_brick, int64_t mask) {
  for (int local = 0; local < kBrickVertices; ++local)
    if (!((mask >> local) & 1)) std::fill_n(grad_brick + local * kRow, kRow, T(0));
}

}  // namespace

template <typename T>
void sparse_adam(T* features, T* grad_features, T* m, T* v, int32_t* last_step, uint8_t* touched,
                 const int64_t* masks, int64_t n_bricks, const AdamStep& adam,
                 const ParallelFor& parallel_for) {
  parallel_for(n_bricks, [&](int64_t begin, int64_t end) {
    for (int64_t b = begin; b < end; ++b) {
      if (!touched[b]) continue;
      const auto brick = [b](T* rows) { return Block<T>(rows + b * kBrickFloats, kBrickFloats); };
      const int64_t skipped = adam.step - 1 - last_step[b];
      if (skipped > 0) {
        brick(m) *= T(std::pow(adam.beta1, skipped));
        brick(v) *= T(std::pow(adam.beta2, skipped));
      }
      if (masks[b] != -1) drop_absent(grad_features + b * kBrickFloats, masks[b]);
      update<T>(brick(features), brick(grad_features), brick(m), brick(v), adam);
      brick(grad_features).setZero();
      last_step[b] = static_cast<int32_t>(adam.step);
      touched[b] = 0;
    }
  });
}

template <typename T>
void adam(T* parameters, const T* gradients, T* m, T* v, int64_t n, const AdamStep& adam) {
  update<T>({parameters, n}, {const_cast<T*>(gradients), n}, {m, n}, {v, n}, adam);
}

#define SNH_INSTANTIATE(T)                                                                                   \
  template void sparse_adam<T>(T*, T*, T*, T*, int32_t*, uint8_t*, const int64_t*, int64_t, const AdamStep&, \
                               const ParallelFor&);                                                          \
  template void adam<T>(T*, const T*, T*, T*, int64_t, const AdamStep&);
SNH_INSTANTIATE(float)
SNH_INSTANTIATE(double)
#undef SNH_INSTANTIATE

}  // namespace snh::cpu
