// sparse_adam: Adam that walks only the bricks that received a gradient, so that a step costs what was seen and not
// what was ever mapped.
//
//   features       [B*64, 4]  parameters, updated
//   grad_features  [B*64, 4]  gradients; rows of touched bricks are zeroed, the others are zero already
//   m, v           [B*64, 4]  moments, updated
//   last_step      [B]        step at which a brick was touched last, 0 = never; updated
//   touched        [B]        1 = this brick has gradients; zeroed
//   masks          [B]        vertices that exist; rows of absent vertices stay zero
//   step                      number of this step, from 1; the same count for all bricks (bias correction)
//
// A brick that was skipped for k steps first has its moments decayed, m *= beta1^k and v *= beta2^k: they are then
// those of dense Adam with zero gradients in between. Its features did not move in between, where dense Adam would
// have let them drift by momentum.
//
// adam: the dense rule for a flat tensor (decoder), so that a mapping step needs no other optimiser.
#pragma once

#include <cstdint>

#include "common/parallel.h"
#include "common/stream.h"

namespace snh {

struct AdamStep {
  int64_t step;  // from 1
  double lr, beta1, beta2, eps;
};

namespace cpu {

template <typename T>
void sparse_adam(T* features, T* grad_features, T* m, T* v, int32_t* last_step, uint8_t* touched,
                 const int64_t* masks, int64_t n_bricks, const AdamStep& adam,
                 const ParallelFor& parallel_for);

template <typename T>
void adam(T* parameters, const T* gradients, T* m, T* v, int64_t n, const AdamStep& adam);

}  // namespace cpu
namespace cuda {

void sparse_adam(float* features, float* grad_features, float* m, float* v, int32_t* last_step,
                 uint8_t* touched, const int64_t* masks, int64_t n_bricks, const AdamStep& adam,
                 Stream stream);

void adam(float* parameters, const float* gradients, float* m, float* v, int64_t n, const AdamStep& adam,
          Stream stream);

}  // namespace cuda
}  // namespace snh
