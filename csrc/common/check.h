// Checks and small helpers of the torch faces: dtype, shape, device, each failure one sentence that names op,
// argument, what was expected and what came.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#include <cstdint>
#include <string>
#include <vector>

#include "common/parallel.h"

namespace snh {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

inline std::string shape_of(const Tensor& t) {
  std::string s = "[";
  for (int64_t d = 0; d < t.dim(); ++d) s += (d ? ", " : "") + std::to_string(t.size(d));
  return s + "]";
}

inline const char* name_of(ScalarType type) { return torch::headeronly::toString(type); }

// shape: one entry per dimension, -1 = any size.
inline void check_shape(const char* op, const char* arg, const Tensor& t, const std::vector<int64_t>& shape) {
  bool ok = t.dim() == static_cast<int64_t>(shape.size());
  for (size_t d = 0; ok && d < shape.size(); ++d)
    ok = shape[d] < 0 || t.size(static_cast<int64_t>(d)) == shape[d];
  if (ok) return;
  std::string want = "[";
  for (size_t d = 0; d < shape.size(); ++d)
    want += (d ? ", " : "") + (shape[d] < 0 ? std::string("*") : std::to_string(shape[d]));
  STD_TORCH_CHECK(false, "snh::", op, ": argument '", arg, "' must have shape ", want, "], got ",
                  shape_of(t));
}

inline void check_dtype(const char* op, const char* arg, const Tensor& t, ScalarType want) {
  STD_TORCH_CHECK(t.scalar_type() == want, "snh::", op, ": argument '", arg, "' must be ", name_of(want),
                  ", got ", name_of(t.scalar_type()));
}

inline void check_floating(const char* op, const char* arg, const Tensor& t) {
  STD_TORCH_CHECK(t.scalar_type() == ScalarType::Float || t.scalar_type() == ScalarType::Double, "snh::", op,
                  ": argument '", arg, "' must be float32 or float64, got ", name_of(t.scalar_type()));
}

// Data of a contiguous tensor. A face calls torch::stable::contiguous() on its inputs first and keeps the result.
template <typename T>
const T* in(const Tensor& t) {
  return static_cast<const T*>(t.const_data_ptr());
}
template <typename T>
T* out(const Tensor& t) {
  return static_cast<T*>(t.mutable_data_ptr());
}

// torch's own thread pool.
inline ParallelFor torch_parallel_for(int64_t grain) {
  return [grain](int64_t n, const std::function<void(int64_t, int64_t)>& body) {
    if (n > 0) torch::stable::parallel_for(0, n, grain, body);
  };
}

}  // namespace snh
