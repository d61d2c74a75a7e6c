#include "ray_sample/ray_sample.h"

#include "common/check.h"
#include "common/cuda_torch.h"

namespace snh {

static Tensor ray_sample(const Tensor& depth, const Tensor& uniforms, int64_t n_base, int64_t n_surface,
                         double near, double far, double truncation) {
  constexpr const char* kOp = "ray_sample";
  STD_TORCH_CHECK(n_base >= 0, "snh::ray_sample: argument 'n_base' must be at least 0, got ", n_base);
  STD_TORCH_CHECK(n_surface >= 0, "snh::ray_sample: argument 'n_surface' must be at least 0, got ",
                  n_surface);
  const DeviceScope scope(kOp, {{"depth", depth}, {"uniforms", uniforms}});
  check_floating(kOp, "depth", depth);
  check_dtype(kOp, "uniforms", uniforms, depth.scalar_type());
  check_shape(kOp, "depth", depth, {-1});
  check_shape(kOp, "uniforms", uniforms, {depth.size(0), n_base + n_surface});
  const Tensor d = torch::stable::contiguous(depth), u = torch::stable::contiguous(uniforms);
  Tensor z = torch::stable::new_empty(d, {d.size(0), n_base + n_surface});
  if (scope.on_cuda()) {
    SNH_KERNELS(cuda::ray_sample(in<float>(d), in<float>(u), d.size(0), static_cast<int>(n_base),
                                 static_cast<int>(n_surface), static_cast<float>(near),
                                 static_cast<float>(far), static_cast<float>(truncation), out<float>(z),
                                 scope.stream());)
    return z;
  }

  const auto call = [&](auto zero) {
    using T = decltype(zero);
    cpu::ray_sample<T>(in<T>(d), in<T>(u), d.size(0), static_cast<int>(n_base), static_cast<int>(n_surface),
                       static_cast<T>(near), static_cast<T>(far), static_cast<T>(truncation), out<T>(z));
  };
  d.scalar_type() == ScalarType::Float ? call(0.0f) : call(0.0);
  return z;
}

}  // namespace snh

SNH_OPS(m) {
  m.def(
      "ray_sample(Tensor depth, Tensor uniforms, int n_base, int n_surface, float near, float far, float "
      "truncation) "
      "-> Tensor");
}
SNH_OPS_IMPL(m) { m.impl("ray_sample", TORCH_BOX(&snh::ray_sample)); }
