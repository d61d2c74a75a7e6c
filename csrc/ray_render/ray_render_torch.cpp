#include "ray_render/ray_render.h"

#include <limits>
#include <optional>
#include <tuple>

#include "common/check.h"
#include "common/cuda_torch.h"

namespace snh {
namespace {

constexpr int64_t kRayGrain = 128;

void check_samples(const char* op, const Tensor& tsdf, const Tensor& color, const Tensor& z) {
  check_floating(op, "tsdf", tsdf);
  check_dtype(op, "color", color, tsdf.scalar_type());
  check_dtype(op, "z", z, tsdf.scalar_type());
  check_shape(op, "tsdf", tsdf, {-1, -1});
  check_shape(op, "color", color, {tsdf.size(0), tsdf.size(1), 3});
  check_shape(op, "z", z, {tsdf.size(0), tsdf.size(1)});
}

std::tuple<Tensor, Tensor, Tensor> ray_render(const Tensor& tsdf, const Tensor& color, const Tensor& z,
                                              double sharpness, std::optional<double> cut_behind) {
  const DeviceScope scope("ray_render", {{"tsdf", tsdf}, {"color", color}, {"z", z}});
  check_samples("ray_render", tsdf, color, z);
  const Tensor s = torch::stable::contiguous(tsdf), c = torch::stable::contiguous(color),
               depths = torch::stable::contiguous(z);
  const int64_t n_rays = s.size(0), n_samples = s.size(1);
  Tensor color_ray = torch::stable::new_empty(s, {n_rays, 3}),
         depth_ray = torch::stable::new_empty(s, {n_rays}),
         weight = torch::stable::new_empty(s, {n_rays, n_samples});
  const double cut = cut_behind.value_or(std::numeric_limits<double>::infinity());
  if (scope.on_cuda()) {
    SNH_KERNELS(cuda::ray_render(in<float>(s), in<float>(c), in<float>(depths), n_rays,
                                 static_cast<int>(n_samples), static_cast<float>(sharpness),
                                 static_cast<float>(cut), out<float>(color_ray), out<float>(depth_ray),
                                 out<float>(weight), scope.stream());)
    return {color_ray, depth_ray, weight};
  }

  const auto call = [&](auto zero) {
    using T = decltype(zero);
    cpu::ray_render<T>(in<T>(s), in<T>(c), in<T>(depths), n_rays, static_cast<int>(n_samples),
                       static_cast<T>(sharpness), static_cast<T>(cut), torch_parallel_for(kRayGrain),
                       out<T>(color_ray), out<T>(depth_ray), out<T>(weight));
  };
  s.scalar_type() == ScalarType::Float ? call(0.0f) : call(0.0);
  return {color_ray, depth_ray, weight};
}

std::tuple<Tensor, Tensor, Tensor> ray_render_backward(const Tensor& grad_color_ray,
                                                       const Tensor& grad_depth_ray,
                                                       const Tensor& grad_weight, const Tensor& tsdf,
                                                       const Tensor& color, const Tensor& z,
                                                       const Tensor& weight, double sharpness) {
  constexpr const char* kOp = "ray_render_backward";
  const DeviceScope scope(kOp, {{"tsdf", tsdf},
                                {"grad_color_ray", grad_color_ray},
                                {"grad_depth_ray", grad_depth_ray},
                                {"grad_weight", grad_weight},
                                {"color", color},
                                {"z", z},
                                {"weight", weight}});
  check_samples(kOp, tsdf, color, z);
  const int64_t n_rays = tsdf.size(0), n_samples = tsdf.size(1);
  const auto checked = [&](const char* arg, const Tensor& t, const std::vector<int64_t>& shape) {
    check_dtype(kOp, arg, t, tsdf.scalar_type());
    check_shape(kOp, arg, t, shape);
    return torch::stable::contiguous(t);
  };
  const Tensor dc = checked("grad_color_ray", grad_color_ray, {n_rays, 3}),
               dz = checked("grad_depth_ray", grad_depth_ray, {n_rays}),
               dp = checked("grad_weight", grad_weight, {n_rays, n_samples}),
               p = checked("weight", weight, {n_rays, n_samples});
  const Tensor s = torch::stable::contiguous(tsdf), c = torch::stable::contiguous(color),
               depths = torch::stable::contiguous(z);
  Tensor grad_tsdf = torch::stable::new_empty(s, {n_rays, n_samples}),
         grad_color = torch::stable::new_empty(s, {n_rays, n_samples, 3}),
         grad_z = torch::stable::new_empty(s, {n_rays, n_samples});

  if (scope.on_cuda()) {
    SNH_KERNELS(cuda::ray_render_backward(in<float>(dc), in<float>(dz), in<float>(dp), in<float>(s),
                                          in<float>(c), in<float>(depths), in<float>(p), n_rays,
                                          static_cast<int>(n_samples), static_cast<float>(sharpness),
                                          out<float>(grad_tsdf), out<float>(grad_color), out<float>(grad_z),
                                          scope.stream());)
    return {grad_tsdf, grad_color, grad_z};
  }
  const auto call = [&](auto zero) {
    using T = decltype(zero);
    cpu::ray_render_backward<T>(in<T>(dc), in<T>(dz), in<T>(dp), in<T>(s), in<T>(c), in<T>(depths), in<T>(p),
                                n_rays, static_cast<int>(n_samples), static_cast<T>(sharpness),
                                torch_parallel_for(kRayGrain), out<T>(grad_tsdf), out<T>(grad_color),
                                out<T>(grad_z));
  };
  s.scalar_type() == ScalarType::Float ? call(0.0f) : call(0.0);
  return {grad_tsdf, grad_color, grad_z};
}

}  // namespace
}  // namespace snh

SNH_OPS(m) {
  m.def(
      "ray_render(Tensor tsdf, Tensor color, Tensor z, float sharpness, float? cut_behind) -> (Tensor, "
      "Tensor, Tensor)");
  m.def(
      "ray_render_backward(Tensor grad_color_ray, Tensor grad_depth_ray, Tensor grad_weight, Tensor tsdf, "
      "Tensor color, Tensor z, Tensor weight, float sharpness) -> (Tensor, Tensor, Tensor)");
}
SNH_OPS_IMPL(m) {
  m.impl("ray_render", TORCH_BOX(&snh::ray_render));
  m.impl("ray_render_backward", TORCH_BOX(&snh::ray_render_backward));
}
