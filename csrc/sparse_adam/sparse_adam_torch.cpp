#include "sparse_adam/sparse_adam.h"

#include "common/check.h"
#include "common/cuda_torch.h"
#include "common/key.h"

namespace snh {
namespace {

// Updated in place, so it must be contiguous already.
void check_inplace(const char* op, const char* arg, const Tensor& t, ScalarType type,
                   const std::vector<int64_t>& shape) {
  check_dtype(op, arg, t, type);
  check_shape(op, arg, t, shape);
  STD_TORCH_CHECK(t.is_contiguous(), "snh::", op, ": argument '", arg,
                  "' is updated in place and must be contiguous");
}

void check_step(const char* op, int64_t step) {
  STD_TORCH_CHECK(step >= 1, "snh::", op, ": argument 'step' counts from 1, got ", step);
}

}  // namespace

static void sparse_adam_(Tensor features, Tensor grad_features, Tensor m, Tensor v, Tensor last_step,
                         Tensor touched, const Tensor& masks, int64_t step, double lr, double beta1,
                         double beta2, double eps) {
  constexpr const char* kOp = "sparse_adam_";
  const int64_t n_bricks = masks.dim() == 1 ? masks.size(0) : -1;
  const DeviceScope scope(kOp, {{"features", features},
                                {"grad_features", grad_features},
                                {"m", m},
                                {"v", v},
                                {"last_step", last_step},
                                {"touched", touched},
                                {"masks", masks}});
  check_floating(kOp, "features", features);
  const ScalarType type = features.scalar_type();
  for (const auto& [arg, t] : {std::pair<const char*, const Tensor&>{"features", features},
                               {"grad_features", grad_features},
                               {"m", m},
                               {"v", v}})
    check_inplace(kOp, arg, t, type, {n_bricks * kBrickVertices, 4});
  check_inplace(kOp, "last_step", last_step, ScalarType::Int, {n_bricks});
  check_inplace(kOp, "touched", touched, ScalarType::Byte, {n_bricks});
  check_inplace(kOp, "masks", masks, ScalarType::Long, {-1});
  check_step(kOp, step);
  const AdamStep adam{step, lr, beta1, beta2, eps};
  if (scope.on_cuda()) {
    SNH_KERNELS(cuda::sparse_adam(out<float>(features), out<float>(grad_features), out<float>(m),
                                  out<float>(v), out<int32_t>(last_step), out<uint8_t>(touched),
                                  in<int64_t>(masks), n_bricks, adam, scope.stream());)
    return;
  }
  const auto call = [&](auto zero) {
    using T = decltype(zero);
    cpu::sparse_adam<T>(out<T>(features), out<T>(grad_features), out<T>(m), out<T>(v),
                        out<int32_t>(last_step), out<uint8_t>(touched), in<int64_t>(masks), n_bricks, adam,
                        torch_parallel_for(64));
  };
  type == ScalarType::Float ? call(0.0f) : call(0.0);
}

static void adam_(Tensor parameters, const Tensor& gradients, Tensor m, Tensor v, int64_t step, double lr,
                  double beta1, double beta2, double eps) {
  constexpr const char* kOp = "adam_";
  const DeviceScope scope(kOp, {{"parameters", parameters}, {"gradients", gradients}, {"m", m}, {"v", v}});
  check_floating(kOp, "parameters", parameters);
  const ScalarType type = parameters.scalar_type();
  const int64_t n = parameters.dim() == 1 ? parameters.size(0) : -1;
  for (const auto& [arg, t] : {std::pair<const char*, const Tensor&>{"parameters", parameters},
                               {"gradients", gradients},
                               {"m", m},
                               {"v", v}})
    check_inplace(kOp, arg, t, type, {n});
  check_step(kOp, step);
  const AdamStep rule{step, lr, beta1, beta2, eps};
  if (scope.on_cuda()) {
    SNH_KERNELS(cuda::adam(out<float>(parameters), in<float>(gradients), out<float>(m), out<float>(v), n,
                           rule, scope.stream());)
    return;
  }
  const auto call = [&](auto zero) {
    using T = decltype(zero);
    cpu::adam<T>(out<T>(parameters), in<T>(gradients), out<T>(m), out<T>(v), n, rule);
  };
  type == ScalarType::Float ? call(0.0f) : call(0.0);
}

}  // namespace snh

SNH_OPS(m) {
  m.def(
      "sparse_adam_(Tensor(a!) features, Tensor(b!) grad_features, Tensor(c!) m, Tensor(d!) v, Tensor(e!) "
      "last_step, "
      "Tensor(f!) touched, Tensor masks, int step, float lr, float beta1, float beta2, float eps) -> ()");
  m.def(
      "adam_(Tensor(a!) parameters, Tensor gradients, Tensor(b!) m, Tensor(c!) v, int step, float lr, float "
      "beta1, "
      "float beta2, float eps) -> ()");
}
SNH_OPS_IMPL(m) {
  m.impl("sparse_adam_", TORCH_BOX(&snh::sparse_adam_));
  m.impl("adam_", TORCH_BOX(&snh::adam_));
}
