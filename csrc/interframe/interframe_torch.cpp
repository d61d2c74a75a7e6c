#include "interframe/interframe.h"

#include <tuple>

#include "common/check.h"
#include "common/cuda_torch.h"

namespace snh {

static std::tuple<Tensor, Tensor, Tensor> interframe(const Tensor& points_c, const Tensor& color,
                                                     const Tensor& T_kc, const Tensor& image, double fx,
                                                     double fy, double cx, double cy) {
  constexpr const char* kOp = "interframe";
  const DeviceScope scope(kOp, {{"points_c", points_c}, {"color", color}, {"T_kc", T_kc}, {"image", image}});
  check_floating(kOp, "points_c", points_c);
  check_dtype(kOp, "color", color, points_c.scalar_type());
  check_dtype(kOp, "T_kc", T_kc, points_c.scalar_type());
  check_dtype(kOp, "image", image, ScalarType::Byte);
  check_shape(kOp, "points_c", points_c, {-1, 3});
  check_shape(kOp, "color", color, {points_c.size(0), 3});
  check_shape(kOp, "T_kc", T_kc, {4, 4});
  check_shape(kOp, "image", image, {-1, -1, 3});
  const Tensor points = torch::stable::contiguous(points_c), c = torch::stable::contiguous(color),
               pose = torch::stable::contiguous(T_kc), pixels = torch::stable::contiguous(image);
  const int64_t n_rays = points.size(0);
  Tensor residuals = torch::stable::new_empty(points, {n_rays, 3}),
         jacobian = torch::stable::new_empty(points, {n_rays, 3, 6}),
         valid = torch::stable::new_empty(points, {n_rays}, ScalarType::Bool);
  if (scope.on_cuda()) {
    const Pinhole<float> pinhole{static_cast<float>(fx), static_cast<float>(fy), static_cast<float>(cx),
                                 static_cast<float>(cy)};
    SNH_KERNELS(cuda::interframe(in<float>(points), in<float>(c), in<float>(pose), in<uint8_t>(pixels),
                                 static_cast<int>(pixels.size(0)), static_cast<int>(pixels.size(1)), pinhole,
                                 n_rays, out<float>(residuals), out<float>(jacobian), out<bool>(valid),
                                 scope.stream());)
    return {residuals, jacobian, valid};
  }

  const auto call = [&](auto zero) {
    using T = decltype(zero);
    const Pinhole<T> pinhole{static_cast<T>(fx), static_cast<T>(fy), static_cast<T>(cx), static_cast<T>(cy)};
    cpu::interframe<T>(in<T>(points), in<T>(c), in<T>(pose), in<uint8_t>(pixels),
                       static_cast<int>(pixels.size(0)), static_cast<int>(pixels.size(1)), pinhole, n_rays,
                       out<T>(residuals), out<T>(jacobian), out<bool>(valid));
  };
  points.scalar_type() == ScalarType::Float ? call(0.0f) : call(0.0);
  return {residuals, jacobian, valid};
}

}  // namespace snh

SNH_OPS(m) {
  m.def(
      "interframe(Tensor points_c, Tensor color, Tensor T_kc, Tensor image, float fx, float fy, float cx, "
      "float cy) -> (Tensor, Tensor, Tensor)");
}
SNH_OPS_IMPL(m) { m.impl("interframe", TORCH_BOX(&snh::interframe)); }
