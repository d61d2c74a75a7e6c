#include "plane_lookup/plane_lookup.h"

#include <algorithm>
#include <optional>
#include <tuple>

#include "common/check.h"
#include "common/cuda_torch.h"
#include "common/lattice.h"

namespace snh {
namespace {

using OptionalTensor = std::optional<Tensor>;

Reduce reduce_of(const std::string& name) {
  STD_TORCH_CHECK(name == "sum" || name == "cat" || name == "prod",
                  "snh::plane_lookup: argument 'reduce' must be 'sum', 'cat' or 'prod', got '", name, "'");
  return name == "sum" ? Reduce::kSum : name == "cat" ? Reduce::kCat : Reduce::kProd;
}

// The checked arguments, contiguous, with what has to outlive the call.
class Arguments {
 public:
  Arguments(const char* op, const Tensor& points, const Tensor& features, const Tensor& probe,
            const Tensor& brick_keys, const Tensor& masks, std::vector<double> cell_sizes, int64_t n_features,
            const std::string& reduce)
      : cell_sizes_(std::move(cell_sizes)),
        n_features_(static_cast<int>(n_features)),
        reduce_(reduce_of(reduce)) {
    check_floating(op, "points", points);
    check_dtype(op, "features", features, points.scalar_type());
    check_dtype(op, "probe", probe, ScalarType::Int);
    check_dtype(op, "brick_keys", brick_keys, ScalarType::Long);
    check_dtype(op, "masks", masks, ScalarType::Long);
    check_shape(op, "points", points, {-1, 3});
    check_shape(op, "features", features, {-1, -1});
    check_shape(op, "probe", probe, {-1});
    check_shape(op, "brick_keys", brick_keys, {-1});
    check_shape(op, "masks", masks, {brick_keys.size(0)});
    const int64_t capacity = probe.size(0), n_bricks = brick_keys.size(0);
    STD_TORCH_CHECK(n_bricks == 0 || ((capacity & (capacity - 1)) == 0 && capacity > n_bricks), "snh::", op,
                    ": argument 'probe' must have a power of two of entries, more than the ", n_bricks,
                    " bricks, got ", capacity);
    STD_TORCH_CHECK(features.size(0) >= n_bricks * kBrickVertices, "snh::", op,
                    ": argument 'features' must have ", n_bricks * kBrickVertices,
                    " rows, 64 per brick, got ", features.size(0));
    STD_TORCH_CHECK(n_features >= 1 && n_features <= features.size(1), "snh::", op,
                    ": argument 'n_features' must be between 1 and the ", features.size(1),
                    " columns of 'features', got ", n_features);
    STD_TORCH_CHECK(cell_sizes_.size() <= kMaxLevels, "snh::", op,
                    ": argument 'cell_sizes' must have at most ", kMaxLevels, " levels, got ",
                    cell_sizes_.size());
    for (const double size : cell_sizes_)
      STD_TORCH_CHECK(size > 0, "snh::", op, ": argument 'cell_sizes' must be positive, got ", size);
    points_ = torch::stable::contiguous(points);
    features_ = torch::stable::contiguous(features);
    probe_ = torch::stable::contiguous(probe);
    brick_keys_ = torch::stable::contiguous(brick_keys);
    masks_ = torch::stable::contiguous(masks);
  }

  int64_t n_points() const { return points_.size(0); }
  int64_t n_levels() const { return static_cast<int64_t>(cell_sizes_.size()); }
  int64_t width() const { return n_levels() * n_features_ * (reduce_ == Reduce::kCat ? 3 : 1); }
  Tensor zeros_like_points(bool wanted) const {
    return torch::stable::new_zeros(points_, {wanted ? n_points() : 0, 3});
  }
  Tensor zeros_like_features(bool wanted) const {
    return torch::stable::new_zeros(features_, {wanted ? features_.size(0) : 0, features_.size(1)});
  }
  const Tensor& points() const { return points_; }
  const Tensor& features() const { return features_; }

  // Calls body with the native arguments, in the type of the points.
  template <typename Body>
  void call(const Body& body) const {
    points_.scalar_type() == ScalarType::Float ? call_typed<float>(body) : call_typed<double>(body);
  }
  template <typename T, typename Body>
  void call_typed(const Body& body) const {
    std::vector<T> inv_cells;
    for (const double size : cell_sizes_) inv_cells.push_back(static_cast<T>(1.0 / size));
    const TableView table{in<int32_t>(probe_), probe_.size(0), in<int64_t>(brick_keys_), in<int64_t>(masks_)};
    body(PlaneLookup<T>{in<T>(points_), n_points(), in<T>(features_), features_.size(1), n_features_, table,
                        inv_cells.data(), static_cast<int>(n_levels()), reduce_});
  }

 private:
  Tensor points_, features_, probe_, brick_keys_, masks_;
  std::vector<double> cell_sizes_;
  int n_features_;
  Reduce reduce_;
};

constexpr int64_t kPointGrain = 512;

std::tuple<Tensor, Tensor> plane_lookup(const Tensor& points, const Tensor& features, const Tensor& probe,
                                        const Tensor& brick_keys, const Tensor& masks,
                                        std::vector<double> cell_sizes, int64_t n_features,
                                        std::string reduce) {
  constexpr const char* kOp = "plane_lookup";
  const DeviceScope scope(kOp, {{"points", points},
                                {"features", features},
                                {"probe", probe},
                                {"brick_keys", brick_keys},
                                {"masks", masks}});
  const Arguments args(kOp, points, features, probe, brick_keys, masks, std::move(cell_sizes), n_features,
                       reduce);
  Tensor encoded = torch::stable::new_empty(args.points(), {args.n_points(), args.width()});
  Tensor valid =
      torch::stable::new_empty(args.points(), {args.n_points(), args.n_levels(), kPlanes}, ScalarType::Bool);
  if (scope.on_cuda()) {
    SNH_KERNELS(args.call_typed<float>([&](const PlaneLookup<float>& native) {
      cuda::plane_lookup(native, out<float>(encoded), out<bool>(valid), scope.stream());
    });)
    return {encoded, valid};
  }
  args.call([&](const auto& native) {
    using T = std::decay_t<decltype(*native.points)>;
    cpu::plane_lookup<T>(native, torch_parallel_for(kPointGrain), out<T>(encoded), out<bool>(valid));
  });
  return {encoded, valid};
}

std::tuple<Tensor, Tensor> plane_lookup_backward(const Tensor& grad_encoded, const Tensor& points,
                                                 const Tensor& features, const Tensor& probe,
                                                 const Tensor& brick_keys, const Tensor& masks,
                                                 std::vector<double> cell_sizes, int64_t n_features,
                                                 std::string reduce, bool need_points, bool need_features) {
  constexpr const char* kOp = "plane_lookup_backward";
  const DeviceScope scope(kOp, {{"grad_encoded", grad_encoded},
                                {"points", points},
                                {"features", features},
                                {"probe", probe},
                                {"brick_keys", brick_keys},
                                {"masks", masks}});
  const Arguments args(kOp, points, features, probe, brick_keys, masks, std::move(cell_sizes), n_features,
                       reduce);
  check_dtype(kOp, "grad_encoded", grad_encoded, points.scalar_type());
  check_shape(kOp, "grad_encoded", grad_encoded, {args.n_points(), args.width()});
  const Tensor grad = torch::stable::contiguous(grad_encoded);
  Tensor grad_points = args.zeros_like_points(need_points),
         grad_features = args.zeros_like_features(need_features);
  if (scope.on_cuda()) {
    SNH_KERNELS(args.call_typed<float>([&](const PlaneLookup<float>& native) {
      cuda::plane_lookup_backward(native, in<float>(grad), need_points ? out<float>(grad_points) : nullptr,
                                  need_features ? out<float>(grad_features) : nullptr, scope.stream());
    });)
    return {grad_points, grad_features};
  }
  args.call([&](const auto& native) {
    using T = std::decay_t<decltype(*native.points)>;
    cpu::plane_lookup_backward<T>(native, in<T>(grad), torch_parallel_for(kPointGrain), torch_parallel_for(1),
                                  need_points ? out<T>(grad_points) : nullptr,
                                  need_features ? out<T>(grad_features) : nullptr);
  });
  return {grad_points, grad_features};
}

std::tuple<Tensor, Tensor, Tensor> plane_lookup_double_backward(
    const OptionalTensor& v_points, const OptionalTensor& v_features, const Tensor& grad_encoded,
    const Tensor& points, const Tensor& features, const Tensor& probe, const Tensor& brick_keys,
    const Tensor& masks, std::vector<double> cell_sizes, int64_t n_features, std::string reduce,
    bool need_features) {
  constexpr const char* kOp = "plane_lookup_double_backward";
  const DeviceScope scope(kOp, {{"grad_encoded", grad_encoded},
                                {"v_points", v_points},
                                {"v_features", v_features},
                                {"points", points},
                                {"features", features},
                                {"probe", probe},
                                {"brick_keys", brick_keys},
                                {"masks", masks}});
  const Arguments args(kOp, points, features, probe, brick_keys, masks, std::move(cell_sizes), n_features,
                       reduce);
  const auto checked = [&](const char* arg, const OptionalTensor& t, int64_t rows,
                           int64_t columns) -> OptionalTensor {
    if (!t) return std::nullopt;
    check_dtype(kOp, arg, *t, points.scalar_type());
    check_shape(kOp, arg, *t, {rows, columns});
    return torch::stable::contiguous(*t);
  };
  const OptionalTensor grad = checked("grad_encoded", grad_encoded, args.n_points(), args.width());
  const OptionalTensor v_p = checked("v_points", v_points, args.n_points(), 3);
  const OptionalTensor v_f = checked("v_features", v_features, features.size(0), features.size(1));

  Tensor grad_grad_encoded = torch::stable::new_empty(*grad, {args.n_points(), args.width()});
  Tensor grad_points = args.zeros_like_points(true), grad_features = args.zeros_like_features(need_features);
  if (scope.on_cuda()) {
    SNH_KERNELS(args.call_typed<float>([&](const PlaneLookup<float>& native) {
      cuda::plane_lookup_double_backward(native, in<float>(*grad), v_p ? in<float>(*v_p) : nullptr,
                                         v_f ? in<float>(*v_f) : nullptr, out<float>(grad_grad_encoded),
                                         out<float>(grad_points),
                                         need_features ? out<float>(grad_features) : nullptr, scope.stream());
    });)
    return {grad_grad_encoded, grad_points, grad_features};
  }
  args.call([&](const auto& native) {
    using T = std::decay_t<decltype(*native.points)>;
    cpu::plane_lookup_double_backward<T>(
        native, in<T>(*grad), v_p ? in<T>(*v_p) : nullptr, v_f ? in<T>(*v_f) : nullptr,
        torch_parallel_for(kPointGrain), torch_parallel_for(1), out<T>(grad_grad_encoded),
        out<T>(grad_points), need_features ? out<T>(grad_features) : nullptr);
  });
  return {grad_grad_encoded, grad_points, grad_features};
}

}  // namespace
}  // namespace snh

SNH_OPS(m) {
  m.def(
      "plane_lookup(Tensor points, Tensor features, Tensor probe, Tensor brick_keys, Tensor masks, "
      "float[] cell_sizes, int n_features, str reduce) -> (Tensor, Tensor)");
  m.def(
      "plane_lookup_backward(Tensor grad_encoded, Tensor points, Tensor features, Tensor probe, Tensor "
      "brick_keys, Tensor masks, float[] cell_sizes, int n_features, str reduce, bool need_points, bool "
      "need_features) -> (Tensor, Tensor)");
  m.def(
      "plane_lookup_double_backward(Tensor? v_points, Tensor? v_features, Tensor grad_encoded, Tensor "
      "points, Tensor features, Tensor probe, Tensor brick_keys, Tensor masks, float[] cell_sizes, int "
      "n_features, str reduce, bool need_features) -> (Tensor, Tensor, Tensor)");
}
SNH_OPS_IMPL(m) {
  m.impl("plane_lookup", TORCH_BOX(&snh::plane_lookup));
  m.impl("plane_lookup_backward", TORCH_BOX(&snh::plane_lookup_backward));
  m.impl("plane_lookup_double_backward", TORCH_BOX(&snh::plane_lookup_double_backward));
}
