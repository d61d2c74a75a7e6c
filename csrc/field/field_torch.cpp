#include "field/field.h"

#include <tuple>

#include "common/check.h"
#include "common/key.h"
#include "field/field_fast.h"

namespace snh {
namespace {

// The arguments that every form shares, checked and contiguous.
struct Scene {
  FieldSpec spec;
  Tensor features, probe, brick_keys, masks, decoder;

  template <typename T>
  FieldModel<T> model() const {
    return {in<int32_t>(probe), probe.size(0),   in<int64_t>(brick_keys), in<int64_t>(masks),
            brick_keys.size(0), in<T>(features), in<T>(decoder)};
  }
};

FieldSpec make_spec(const char* op, const std::vector<double>& cell_sizes, int64_t n_features,
                    int64_t n_octaves, double base_wavelength, int64_t hidden, int64_t n_geometry,
                    double truncation, double sharpness, bool cut_behind) {
  const int64_t n_levels = static_cast<int64_t>(cell_sizes.size());
  STD_TORCH_CHECK(n_levels >= 1 && n_levels <= kMaxLevels, "snh::", op,
                  ": argument 'cell_sizes' must have 1 to ", kMaxLevels, " levels, got ", n_levels);
  STD_TORCH_CHECK(n_features >= 1 && n_features <= kFeatureStride, "snh::", op,
                  ": argument 'n_features' must be 1 to ", kFeatureStride, ", got ", n_features);
  STD_TORCH_CHECK(n_octaves >= 0 && hidden >= 1 && n_geometry >= 0, "snh::", op,
                  ": 'n_octaves' and 'n_geometry' must not be negative and 'hidden' must be at least 1");
  FieldSpec spec{static_cast<int>(n_levels),
                 static_cast<int>(n_features),
                 static_cast<int>(n_octaves),
                 static_cast<int>(hidden),
                 static_cast<int>(n_geometry),
                 {},
                 base_wavelength,
                 truncation,
                 sharpness,
                 cut_behind};
  for (int64_t l = 0; l < n_levels; ++l) spec.cell_sizes[l] = cell_sizes[l];
  return spec;
}

Scene make_scene(const char* op, const Tensor& features, const Tensor& probe, const Tensor& brick_keys,
                 const Tensor& masks, const Tensor& decoder, const FieldSpec& spec) {
  check_floating(op, "features", features);
  check_dtype(op, "decoder", decoder, features.scalar_type());
  check_dtype(op, "probe", probe, ScalarType::Int);
  check_dtype(op, "brick_keys", brick_keys, ScalarType::Long);
  check_dtype(op, "masks", masks, ScalarType::Long);
  check_shape(op, "probe", probe, {-1});
  check_shape(op, "brick_keys", brick_keys, {-1});
  const int64_t n_bricks = brick_keys.size(0), capacity = probe.size(0);
  check_shape(op, "masks", masks, {n_bricks});
  check_shape(op, "features", features, {n_bricks * kBrickVertices, kFeatureStride});
  check_shape(op, "decoder", decoder, {spec.decoder_size()});
  STD_TORCH_CHECK((capacity & (capacity - 1)) == 0 && (capacity == 0 ? n_bricks == 0 : capacity > n_bricks),
                  "snh::", op, ": argument 'probe' must have a power of two of more than ", n_bricks,
                  " places, got ", capacity);
  using torch::stable::contiguous;
  return {spec,
          contiguous(features),
          contiguous(probe),
          contiguous(brick_keys),
          contiguous(masks),
          contiguous(decoder)};
}

// Rays of the map and track forms, checked and contiguous; `color` and `frame_index` null for track.
struct RayTensors {
  Tensor dirs_c, depth, T_wc, uniforms;
  const Tensor *color, *frame_index;

  template <typename T>
  FieldRays<T> rays() const {
    return {in<T>(dirs_c),
            in<T>(depth),
            color ? in<T>(*color) : nullptr,
            frame_index ? in<int32_t>(*frame_index) : nullptr,
            in<T>(T_wc),
            in<T>(uniforms),
            depth.size(0),
            color ? T_wc.size(0) : 1};
  }
};

Tensor checked(const char* op, const char* arg, const Tensor& t, ScalarType type,
               const std::vector<int64_t>& shape) {
  check_dtype(op, arg, t, type);
  check_shape(op, arg, t, shape);
  return torch::stable::contiguous(t);
}

void check_frames(const char* op, const Tensor& frame_index, int64_t n_frames) {
  const int32_t* index = in<int32_t>(frame_index);
  for (int64_t r = 0; r < frame_index.size(0); ++r)
    STD_TORCH_CHECK(index[r] >= 0 && index[r] < n_frames, "snh::", op,
                    ": argument 'frame_index' must be in 0 .. ", n_frames - 1, ", got ", index[r],
                    " for ray ", r);
}

// The implementation that a call asks for: "reference" or an instruction set. "auto" takes the best instruction set
// for what the fast implementation covers: float32, at least one sample, tables of at most 2^24 bricks.
std::string choose(const char* op, const std::string& impl, const Scene& scene, int64_t n_samples) {
  const bool covered = scene.features.scalar_type() == ScalarType::Float && n_samples > 0 &&
                       scene.brick_keys.size(0) <= fast::kMaxBricks;
  if (impl == "auto") return covered ? fast::best_set() : "reference";
  if (impl == "reference") return impl;
  STD_TORCH_CHECK(impl == "baseline" || impl == "avx2" || impl == "avx512", "snh::", op,
                  ": argument 'impl' must be 'auto', 'reference', 'baseline', 'avx2' or 'avx512', got '",
                  impl, "'");
  STD_TORCH_CHECK(fast::has_set(impl), "snh::", op, ": this processor or this build does not have '", impl,
                  "'");
  STD_TORCH_CHECK(
      covered, "snh::", op, ": '", impl,
      "' needs float32, at least one sample per ray and at most 2^24 bricks; use 'auto' or 'reference'");
  return impl;
}

int n_threads() { return static_cast<int>(torch::stable::get_num_threads()); }

// Output that the caller owns: it is written in place, so it must be contiguous already.
void check_output(const char* op, const char* arg, const Tensor& t, ScalarType type,
                  const std::vector<int64_t>& shape) {
  check_dtype(op, arg, t, type);
  check_shape(op, arg, t, shape);
  STD_TORCH_CHECK(t.is_contiguous(), "snh::", op, ": argument '", arg,
                  "' is written in place and must be contiguous");
}

struct MapTargets {
  const Tensor &features, &touched, &decoder, &T_wc;
};

template <typename T>
FieldGradients<T> gradients_of(const MapTargets* targets) {
  if (!targets) return {};
  return {out<T>(targets->features), out<uint8_t>(targets->touched), out<T>(targets->decoder),
          out<T>(targets->T_wc)};
}

Tensor run_map(const char* op, const Scene& scene, const Tensor& dirs_c, const Tensor& depth,
               const Tensor& color, const Tensor& frame_index, const Tensor& T_wc, const Tensor& uniforms,
               int64_t n_base, int64_t n_surface, double near, double far, const double lambdas[4],
               const MapTargets* targets, const std::string& impl) {
  const ScalarType type = scene.features.scalar_type();
  const int64_t n_rays = depth.dim() == 1 ? depth.size(0) : -1;
  const Tensor color_c = checked(op, "color", color, type, {n_rays, 3});
  const Tensor index_c = checked(op, "frame_index", frame_index, ScalarType::Int, {n_rays});
  const RayTensors tensors{checked(op, "dirs_c", dirs_c, type, {n_rays, 3}),
                           checked(op, "depth", depth, type, {-1}),
                           checked(op, "T_wc", T_wc, type, {-1, 4, 4}),
                           checked(op, "uniforms", uniforms, type, {n_rays, n_base + n_surface}),
                           &color_c,
                           &index_c};
  const int64_t n_frames = tensors.T_wc.size(0), n_bricks = scene.brick_keys.size(0);
  check_frames(op, index_c, n_frames);
  if (targets) {
    check_output(op, "grad_features", targets->features, type, {n_bricks * kBrickVertices, kFeatureStride});
    check_output(op, "touched", targets->touched, ScalarType::Byte, {n_bricks});
    check_output(op, "grad_decoder", targets->decoder, type, {scene.spec.decoder_size()});
    check_output(op, "grad_T_wc", targets->T_wc, type, {n_frames, 3, 4});
  }
  Tensor losses = torch::stable::new_empty(scene.features, {4});
  const FieldSampling sampling{static_cast<int>(n_base), static_cast<int>(n_surface), near, far};

  const std::string chosen = choose(op, impl, scene, n_base + n_surface);
  if (chosen != "reference") {
    const float weights[4] = {float(lambdas[0]), float(lambdas[1]), float(lambdas[2]), float(lambdas[3])};
    fast::field_map(chosen, scene.spec, scene.model<float>(), tensors.rays<float>(), sampling, weights,
                    gradients_of<float>(targets), out<float>(losses), n_threads(), torch_parallel_for(1));
    return losses;
  }
  const auto call = [&](auto zero) {
    using T = decltype(zero);
    const T weights[4] = {T(lambdas[0]), T(lambdas[1]), T(lambdas[2]), T(lambdas[3])};
    cpu::field_map<T>(scene.spec, scene.model<T>(), tensors.rays<T>(), sampling, weights,
                      gradients_of<T>(targets), out<T>(losses));
  };
  type == ScalarType::Float ? call(0.0f) : call(0.0);
  return losses;
}

}  // namespace

#define SNH_SCENE_PARAMETERS                                                                           \
  const Tensor &features, const Tensor &probe, const Tensor &brick_keys, const Tensor &masks,          \
      const Tensor &decoder, std::vector<double> cell_sizes, int64_t n_features, int64_t n_octaves,    \
      double base_wavelength, int64_t hidden, int64_t n_geometry, double truncation, double sharpness, \
      bool cut_behind
#define SNH_SCENE(op)                                                                              \
  make_scene(op, features, probe, brick_keys, masks, decoder,                                      \
             make_spec(op, cell_sizes, n_features, n_octaves, base_wavelength, hidden, n_geometry, \
                       truncation, sharpness, cut_behind))
#define SNH_MAP_PARAMETERS                                                                                 \
  const Tensor &dirs_c, const Tensor &depth, const Tensor &color, const Tensor &frame_index,               \
      const Tensor &T_wc, const Tensor &uniforms, SNH_SCENE_PARAMETERS, int64_t n_base, int64_t n_surface, \
      double near, double far

static Tensor field_map_(SNH_MAP_PARAMETERS, std::vector<double> lambdas, Tensor grad_features,
                         Tensor touched, Tensor grad_decoder, Tensor grad_T_wc, std::string impl) {
  STD_TORCH_CHECK(lambdas.size() == 4, "snh::field_map_: argument 'lambdas' must have 4 entries, got ",
                  lambdas.size());
  const MapTargets targets{grad_features, touched, grad_decoder, grad_T_wc};
  return run_map("field_map_", SNH_SCENE("field_map_"), dirs_c, depth, color, frame_index, T_wc, uniforms,
                 n_base, n_surface, near, far, lambdas.data(), &targets, impl);
}

static Tensor field_map(SNH_MAP_PARAMETERS, std::string impl) {
  const double lambdas[4] = {0, 0, 0, 0};
  return run_map("field_map", SNH_SCENE("field_map"), dirs_c, depth, color, frame_index, T_wc, uniforms,
                 n_base, n_surface, near, far, lambdas, nullptr, impl);
}

// The losses are linear in lambda, so the gradient of the losses as seen from outside are the lambdas.
static std::tuple<Tensor, Tensor, Tensor> field_map_backward(const Tensor& grad_losses, SNH_MAP_PARAMETERS,
                                                             std::string impl) {
  constexpr const char* kOp = "field_map_backward";
  const Scene scene = SNH_SCENE(kOp);
  const Tensor grad = checked(kOp, "grad_losses", grad_losses, scene.features.scalar_type(), {4});
  double lambdas[4];
  for (int k = 0; k < 4; ++k)
    lambdas[k] = grad.scalar_type() == ScalarType::Float ? in<float>(grad)[k] : in<double>(grad)[k];
  Tensor grad_features = torch::stable::new_zeros(scene.features, {features.size(0), features.size(1)});
  Tensor touched = torch::stable::new_zeros(scene.features, {brick_keys.size(0)}, ScalarType::Byte);
  Tensor grad_decoder = torch::stable::new_empty(scene.features, {decoder.size(0)});
  Tensor grad_T_wc = torch::stable::new_empty(scene.features, {T_wc.size(0), 3, 4});
  const MapTargets targets{grad_features, touched, grad_decoder, grad_T_wc};
  run_map(kOp, scene, dirs_c, depth, color, frame_index, T_wc, uniforms, n_base, n_surface, near, far,
          lambdas, &targets, impl);
  return {grad_features, grad_decoder, grad_T_wc};
}

static std::tuple<Tensor, Tensor, Tensor> field_track(const Tensor& dirs_c, const Tensor& depth,
                                                      const Tensor& T_wc, const Tensor& uniforms,
                                                      SNH_SCENE_PARAMETERS, double band, std::string impl) {
  constexpr const char* kOp = "field_track";
  const Scene scene = SNH_SCENE(kOp);
  const ScalarType type = scene.features.scalar_type();
  const int64_t n_rays = depth.dim() == 1 ? depth.size(0) : -1;
  const RayTensors tensors{checked(kOp, "dirs_c", dirs_c, type, {n_rays, 3}),
                           checked(kOp, "depth", depth, type, {-1}),
                           checked(kOp, "T_wc", T_wc, type, {4, 4}),
                           checked(kOp, "uniforms", uniforms, type, {n_rays, -1}),
                           nullptr,
                           nullptr};
  const int64_t n_samples = uniforms.size(1);
  Tensor residuals = torch::stable::new_empty(scene.features, {n_rays, n_samples});
  Tensor jacobian = torch::stable::new_empty(scene.features, {n_rays, n_samples, 6});
  Tensor valid = torch::stable::new_empty(scene.features, {n_rays, n_samples}, ScalarType::Bool);
  const std::string chosen = choose(kOp, impl, scene, n_samples);
  if (chosen != "reference") {
    fast::field_track(chosen, scene.spec, scene.model<float>(), tensors.rays<float>(),
                      static_cast<int>(n_samples), static_cast<float>(band), out<float>(residuals),
                      out<float>(jacobian), out<bool>(valid), n_threads(), torch_parallel_for(1));
    return {residuals, jacobian, valid};
  }
  const auto call = [&](auto zero) {
    using T = decltype(zero);
    cpu::field_track<T>(scene.spec, scene.model<T>(), tensors.rays<T>(), static_cast<int>(n_samples), T(band),
                        out<T>(residuals), out<T>(jacobian), out<bool>(valid));
  };
  type == ScalarType::Float ? call(0.0f) : call(0.0);
  return {residuals, jacobian, valid};
}

static std::tuple<Tensor, Tensor, Tensor> field_query(const Tensor& points, SNH_SCENE_PARAMETERS,
                                                      bool with_color, std::string impl) {
  constexpr const char* kOp = "field_query";
  const Scene scene = SNH_SCENE(kOp);
  const Tensor x = checked(kOp, "points", points, scene.features.scalar_type(), {-1, 3});
  const int64_t n = x.size(0);
  Tensor tsdf = torch::stable::new_empty(x, {n});
  Tensor color = torch::stable::new_empty(x, {with_color ? n : 0, 3});
  Tensor valid = torch::stable::new_empty(x, {n}, ScalarType::Bool);
  const std::string chosen = choose(kOp, impl, scene, 1);
  if (chosen != "reference") {
    fast::field_query(chosen, scene.spec, scene.model<float>(), in<float>(x), n, out<float>(tsdf),
                      with_color ? out<float>(color) : nullptr, out<bool>(valid), n_threads(),
                      torch_parallel_for(1));
    return {tsdf, color, valid};
  }
  const auto call = [&](auto zero) {
    using T = decltype(zero);
    cpu::field_query<T>(scene.spec, scene.model<T>(), in<T>(x), n, out<T>(tsdf),
                        with_color ? out<T>(color) : nullptr, out<bool>(valid));
  };
  x.scalar_type() == ScalarType::Float ? call(0.0f) : call(0.0);
  return {tsdf, color, valid};
}

}  // namespace snh

#define SNH_SCENE_SCHEMA                                                                                 \
  "Tensor features, Tensor probe, Tensor brick_keys, Tensor masks, Tensor decoder, float[] cell_sizes, " \
  "int n_features, int n_octaves, float base_wavelength, int hidden, int n_geometry, float truncation, " \
  "float sharpness, bool cut_behind"
#define SNH_MAP_SCHEMA                                                                  \
  "Tensor dirs_c, Tensor depth, Tensor color, Tensor frame_index, Tensor T_wc, Tensor " \
  "uniforms, " SNH_SCENE_SCHEMA ", int n_base, int n_surface, float near, float far"

STABLE_TORCH_LIBRARY_FRAGMENT(snh, m) {
  m.def("field_map_(" SNH_MAP_SCHEMA
        ", float[] lambdas, Tensor(a!) grad_features, Tensor(b!) touched, Tensor(c!) grad_decoder, "
        "Tensor(d!) grad_T_wc, str impl) -> Tensor");
  m.def("field_map(" SNH_MAP_SCHEMA ", str impl) -> Tensor");
  m.def("field_map_backward(Tensor grad_losses, " SNH_MAP_SCHEMA ", str impl) -> (Tensor, Tensor, Tensor)");
  m.def("field_track(Tensor dirs_c, Tensor depth, Tensor T_wc, Tensor uniforms, " SNH_SCENE_SCHEMA
        ", float band, str impl) -> (Tensor, Tensor, Tensor)");
  m.def("field_query(Tensor points, " SNH_SCENE_SCHEMA
        ", bool with_color, str impl) -> (Tensor, Tensor, Tensor)");
}
STABLE_TORCH_LIBRARY_IMPL(snh, CPU, m) {
  m.impl("field_map_", TORCH_BOX(&snh::field_map_));
  m.impl("field_map", TORCH_BOX(&snh::field_map));
  m.impl("field_map_backward", TORCH_BOX(&snh::field_map_backward));
  m.impl("field_track", TORCH_BOX(&snh::field_track));
  m.impl("field_query", TORCH_BOX(&snh::field_query));
}
