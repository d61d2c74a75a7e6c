// The explanation: matrices have one column per sample. Speed lives in field_simd.cpp.
#include "field/field.h"

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <vector>

#include "common/key.h"
#include "ray_render/ray_render.h"
#include "ray_sample/ray_sample.h"

namespace snh::cpu {
namespace {

template <typename T>
using Vector = Eigen::Matrix<T, Eigen::Dynamic, 1>;
template <typename T>
using Row = Eigen::Array<T, 1, Eigen::Dynamic>;
template <typename T>
using Matrix = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic>;
template <typename T>
using Points = Eigen::Matrix<T, 3, Eigen::Dynamic>;
template <typename T>
using Vector3 = Eigen::Matrix<T, 3, 1>;
template <typename T>
using Matrix3 = Eigen::Matrix<T, 3, 3, Eigen::RowMajor>;
template <typename T>
using Pose = Eigen::Matrix<T, 4, 4, Eigen::RowMajor>;
template <typename T>
using PoseGradient = Eigen::Matrix<T, 3, 4, Eigen::RowMajor>;

// --- f_g and f_c: three linear layers with ReLU between -----------------------------------------------------------

template <typename T>
struct Layer {
  using Weights = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  Eigen::Map<Weights> W;
  Eigen::Map<Vector<T>> b;

  Layer(T*& cursor, int n_in, int n_out) : W(cursor, n_out, n_in), b(cursor + W.size(), n_out) {
    cursor += W.size() + n_out;
  }
  Matrix<T> operator()(const Matrix<T>& x) const { return (W * x).colwise() + b; }
};

template <typename T>
struct Mlp {
  Layer<T> layer1, layer2, layer3;
  Mlp(T*& cursor, int n_in, int hidden, int n_out)
      : layer1(cursor, n_in, hidden), layer2(cursor, hidden, hidden), layer3(cursor, hidden, n_out) {}
};

// f_g and f_c over the flat decoder, or over its gradient.
template <typename T>
struct Decoder {
  Mlp<T> geometry, color;
  Decoder(T* flat, const FieldSpec& spec)
      : geometry(flat, spec.n_encoding(), spec.hidden, 1 + spec.n_geometry),
        color(flat, spec.n_gamma() + spec.n_geometry, spec.hidden, 3) {}
};

// The activations of one evaluation, for its backward pass.
template <typename T>
struct MlpTrace {
  Matrix<T> input, hidden1, hidden2, output;
};

template <typename T>
MlpTrace<T> forward(const Mlp<T>& mlp, const Matrix<T>& input) {
  MlpTrace<T> trace;
  trace.input = input;
  trace.hidden1 = mlp.layer1(trace.input).cwiseMax(T(0));
  trace.hidden2 = mlp.layer2(trace.hidden1).cwiseMax(T(0));
  trace.output = mlp.layer3(trace.hidden2);
  return trace;
}

template <typename T>
Matrix<T> through_relu(const Matrix<T>& grad, const Matrix<T>& activation) {
  return (activation.array() > T(0)).select(grad, T(0));
}

// Gradient of the input; those of the weights are added to `grad_mlp` if there is one.
template <typename T>
Matrix<T> backward(const Mlp<T>& mlp, const MlpTrace<T>& trace, const Matrix<T>& grad_output,
                   Mlp<T>* grad_mlp) {
  const Matrix<T> grad2 = through_relu<T>(mlp.layer3.W.transpose() * grad_output, trace.hidden2);
  const Matrix<T> grad1 = through_relu<T>(mlp.layer2.W.transpose() * grad2, trace.hidden1);
  if (grad_mlp) {
    const auto add = [](Layer<T>& layer, const Matrix<T>& grad, const Matrix<T>& input) {
      layer.W += grad * input.transpose();
      layer.b += grad.rowwise().sum();
    };
    add(grad_mlp->layer3, grad_output, trace.hidden2);
    add(grad_mlp->layer2, grad2, trace.hidden1);
    add(grad_mlp->layer1, grad1, trace.input);
  }
  return mlp.layer1.W.transpose() * grad1;
}

// --- gamma --------------------------------------------------------------------------------------------------------

template <typename T>
T wave_number(const FieldSpec& spec, int octave) {
  return T(2 * M_PI * std::ldexp(1.0, octave) / spec.base_wavelength);
}

template <typename T>
Matrix<T> gamma(const FieldSpec& spec, const Points<T>& x) {
  Matrix<T> g(spec.n_gamma(), x.cols());
  for (int o = 0; o < spec.n_octaves; ++o) {
    const auto angle = (wave_number<T>(spec, o) * x).array();
    g.middleRows(6 * o, 3) = angle.sin();
    g.middleRows(6 * o + 3, 3) = angle.cos();
  }
  return g;
}

// d sin(kx) = k cos(kx) dx, d cos(kx) = -k sin(kx) dx; both are in gamma already.
template <typename T>
Points<T> gamma_backward(const FieldSpec& spec, const Matrix<T>& g, const Matrix<T>& grad) {
  Points<T> grad_x = Points<T>::Zero(3, g.cols());
  for (int o = 0; o < spec.n_octaves; ++o)
    grad_x += wave_number<T>(spec, o) * (grad.middleRows(6 * o, 3).cwiseProduct(g.middleRows(6 * o + 3, 3)) -
                                         grad.middleRows(6 * o + 3, 3).cwiseProduct(g.middleRows(6 * o, 3)));
  return grad_x;
}

// --- look-up in the planes (eq. 4) --------------------------------------------------------------------------------

// A corner of the cell that holds a point: its slot (-1 = absent), bilinear weight, and the weight's derivatives to
// the coordinates of the plane, 1 / m.
template <typename T>
struct Corner {
  int64_t slot;
  T weight, weight_u, weight_v;
};

template <typename T>
void find_corners(const FieldSpec& spec, const FieldModel<T>& model, const Vector3<T>& x, int level,
                  int plane, Corner<T> corners[4]) {
  const T inv_cell = T(1 / spec.cell_sizes[level]);
  const T u = to_cells(x[axis_u(plane)], inv_cell), v = to_cells(x[axis_v(plane)], inv_cell);
  const int32_t i = floor_cell(u), j = floor_cell(v);
  const T fu = u - T(i), fv = v - T(j);
  for (int c = 0; c < 4; ++c) {
    const int di = c & 1, dj = c >> 1;
    const T wu = di ? fu : 1 - fu, wv = dj ? fv : 1 - fv;
    corners[c] = {
        find_slot(level, plane, i + di, j + dj, model.probe, model.capacity, model.brick_keys, model.masks),
        wu * wv, (di ? inv_cell : -inv_cell) * wv, wu * (dj ? inv_cell : -inv_cell)};
  }
}

// Calls body(sample, level, plane, corner) for every corner of every sample that exists; false in `valid` where one
// does not.
template <typename T, typename Body>
void for_each_corner(const FieldSpec& spec, const FieldModel<T>& model, const Points<T>& x, bool* valid,
                     const Body& body) {
  for (int n = 0; n < x.cols(); ++n) {
    if (valid) valid[n] = true;
    for (int level = 0; level < spec.n_levels; ++level)
      for (int plane = 0; plane < kPlanes; ++plane) {
        Corner<T> corners[4];
        find_corners<T>(spec, model, x.col(n), level, plane, corners);
        for (const Corner<T>& corner : corners) {
          if (corner.slot >= 0)
            body(n, level, plane, corner);
          else if (valid)
            valid[n] = false;
        }
      }
  }
}

template <typename T>
auto feature(const FieldModel<T>& model, int64_t slot, int n_features) {
  return Eigen::Map<const Vector<T>>(model.features + slot * kFeatureStride, n_features);
}

template <typename T>
Matrix<T> look_up(const FieldSpec& spec, const FieldModel<T>& model, const Points<T>& x, bool* valid) {
  const int F = spec.n_features;
  Matrix<T> encoded = Matrix<T>::Zero(spec.n_levels * F, x.cols());
  for_each_corner(spec, model, x, valid, [&](int n, int level, int, const Corner<T>& corner) {
    encoded.col(n).segment(level * F, F) += corner.weight * feature(model, corner.slot, F);
  });
  return encoded;
}

// Adds to the gradients of the features, if wanted, and returns that of the points.
template <typename T>
Points<T> look_up_backward(const FieldSpec& spec, const FieldModel<T>& model, const Points<T>& x,
                           const Matrix<T>& grad_encoded, T* grad_features, uint8_t* touched) {
  const int F = spec.n_features;
  Points<T> grad_x = Points<T>::Zero(3, x.cols());
  for_each_corner(spec, model, x, nullptr, [&](int n, int level, int plane, const Corner<T>& corner) {
    const Vector<T> grad = grad_encoded.col(n).segment(level * F, F);
    const T along = grad.dot(feature(model, corner.slot, F));
    grad_x(axis_u(plane), n) += along * corner.weight_u;
    grad_x(axis_v(plane), n) += along * corner.weight_v;
    if (grad_features) {
      Eigen::Map<Vector<T>>(grad_features + corner.slot * kFeatureStride, F) += corner.weight * grad;
      touched[corner.slot / kBrickVertices] = 1;
    }
  });
  return grad_x;
}

// --- the field at points (eq. 5) ----------------------------------------------------------------------------------

template <typename T>
struct FieldTrace {
  Matrix<T> gamma;
  MlpTrace<T> geometry;
  MlpTrace<T> color;  // output before the sigmoid

  Row<T> tsdf() const { return geometry.output.row(0); }
};

template <typename T>
Matrix<T> stack(const Matrix<T>& top, const Matrix<T>& bottom) {
  Matrix<T> both(top.rows() + bottom.rows(), top.cols());
  both << top, bottom;
  return both;
}

template <typename T>
FieldTrace<T> decode(const FieldSpec& spec, const FieldModel<T>& model, const Decoder<T>& decoder,
                     const Points<T>& x, bool with_color, bool* valid) {
  FieldTrace<T> trace;
  trace.gamma = gamma(spec, x);
  trace.geometry = forward(decoder.geometry, stack<T>(trace.gamma, look_up(spec, model, x, valid)));
  if (with_color) {
    const Matrix<T> rho = trace.geometry.output.bottomRows(spec.n_geometry);
    trace.color = forward(decoder.color, stack<T>(trace.gamma, rho));
  }
  return trace;
}

// Gradient of the points from those of [tsdf, rho] and gamma; adds to the other gradients, if wanted.
template <typename T>
Points<T> decode_backward(const FieldSpec& spec, const FieldModel<T>& model, const Mlp<T>& geometry,
                          const FieldTrace<T>& trace, const Points<T>& x, const Matrix<T>& grad_output,
                          const Matrix<T>& grad_gamma, Mlp<T>* grad_geometry, T* grad_features,
                          uint8_t* touched) {
  const Matrix<T> grad_input = backward(geometry, trace.geometry, grad_output, grad_geometry);
  const Points<T> through_features = look_up_backward<T>(
      spec, model, x, grad_input.bottomRows(spec.n_levels * spec.n_features), grad_features, touched);
  return through_features +
         gamma_backward<T>(spec, trace.gamma, grad_gamma + grad_input.topRows(spec.n_gamma()));
}

// --- rendering and losses (eq. 6-10) ------------------------------------------------------------------------------

// Eq. 6, cut and normalised as in ray_render.
template <typename T>
Row<T> render_weights(const FieldSpec& spec, const Row<T>& tsdf, const Row<T>& z) {
  Row<T> weight = (T(spec.sharpness) * tsdf).unaryExpr([](T x) { return bell(x); });
  if (spec.cut_behind) {
    const T deepest = cut_depth(tsdf.data(), z.data(), static_cast<int>(z.size()), T(spec.truncation));
    weight = (z > deepest).select(T(0), weight);
  }
  return weight / (weight.sum() + T(kWeightEpsilon));
}

// Losses of one ray and their gradients to tsdf and colour (before the sigmoid) of its samples.
template <typename T>
struct RayLoss {
  T losses[4];
  Row<T> grad_tsdf;
  Points<T> grad_color;
};

template <typename T>
RayLoss<T> judge_ray(const FieldSpec& spec, const Row<T>& z, const FieldTrace<T>& trace, T depth,
                     const Vector3<T>& color, const T lambdas[4]) {
  const Row<T> tsdf = trace.tsdf();
  const T truncation = T(spec.truncation);
  RayLoss<T> ray;

  // Eq. 7 and 8.
  const Row<T> p = render_weights(spec, tsdf, z);
  const Points<T> colors = (1 + (-trace.color.output.array()).exp()).inverse();
  const Vector3<T> color_error = colors * p.matrix().transpose() - color;
  const T depth_error = (p * z).sum() - depth;
  ray.losses[0] = color_error.squaredNorm() / 3;
  ray.losses[1] = depth_error * depth_error;

  // dL/dp_i = g_i gives dL/ds_i = w'/w (g_i - sum_j p_j g_j) p_i, as w'(x) = -tanh(x / 2) w(x).
  const Vector3<T> grad_color_ray = lambdas[0] * T(2) / T(3) * color_error;
  Row<T> g = grad_color_ray.transpose() * colors;
  g += lambdas[1] * 2 * depth_error * z;
  ray.grad_tsdf = -T(spec.sharpness) * (T(spec.sharpness) / 2 * tsdf).tanh() * p * (g - (p * g).sum());
  ray.grad_color = (grad_color_ray * p.matrix()).array() * colors.array() * (1 - colors.array());

  // Eq. 9 and 10.
  const Row<T> in_free = (depth - z > truncation).template cast<T>();
  const Row<T> near_surface = ((depth - z).abs() <= truncation).template cast<T>();
  const T n_free = std::max(in_free.sum(), T(1)), n_surface = std::max(near_surface.sum(), T(1));
  const Row<T> free_error = in_free * (tsdf - 1),
               surface_error = near_surface * (z + truncation * tsdf - depth);
  ray.losses[2] = free_error.square().sum() / n_free;
  ray.losses[3] = surface_error.square().sum() / n_surface;
  ray.grad_tsdf +=
      lambdas[2] * 2 / n_free * free_error + lambdas[3] * 2 / n_surface * truncation * surface_error;
  return ray;
}

}  // namespace

// --- the three forms ----------------------------------------------------------------------------------------------

template <typename T>
void field_map(const FieldSpec& spec, const FieldModel<T>& model, const FieldRays<T>& rays,
               const FieldSampling& sampling, const T lambdas[4], const FieldGradients<T>& gradients,
               T losses[4]) {
  const int S = sampling.n_base + sampling.n_surface;
  const bool with_gradients = gradients.features != nullptr;
  std::vector<T> no_gradient(with_gradients ? 0 : spec.decoder_size());
  const Decoder<T> decoder(const_cast<T*>(model.decoder), spec);
  Decoder<T> grad_decoder(with_gradients ? gradients.decoder : no_gradient.data(), spec);
  if (with_gradients) {
    std::fill_n(gradients.decoder, spec.decoder_size(), T(0));
    std::fill_n(gradients.T_wc, rays.n_frames * 12, T(0));
  }
  std::fill_n(losses, 4, T(0));
  const T share = rays.n_rays ? T(1) / T(rays.n_rays) : T(0);  // of one ray in the means
  const T ray_lambdas[4] = {lambdas[0] * share, lambdas[1] * share, lambdas[2] * share, lambdas[3] * share};

  Row<T> z(S);
  for (int64_t r = 0; r < rays.n_rays; ++r) {
    const int64_t frame = rays.frame_index ? rays.frame_index[r] : 0;
    const Eigen::Map<const Pose<T>> T_wc(rays.T_wc + frame * 16);
    const Matrix3<T> R = T_wc.template topLeftCorner<3, 3>();
    const Vector3<T> t = T_wc.template topRightCorner<3, 1>();
    const Vector3<T> dir_c = Eigen::Map<const Vector3<T>>(rays.dirs_c + r * 3);
    const Vector3<T> color = Eigen::Map<const Vector3<T>>(rays.color + r * 3);
    ray_sample(rays.depth + r, rays.uniforms + r * S, 1, sampling.n_base, sampling.n_surface,
               T(sampling.near), T(sampling.far), T(spec.truncation), z.data());

    const Points<T> points_c = dir_c * z.matrix();
    const Points<T> points_w = (R * points_c).colwise() + t;
    const FieldTrace<T> trace = decode(spec, model, decoder, points_w, true, nullptr);
    const RayLoss<T> ray = judge_ray(spec, z, trace, rays.depth[r], color, ray_lambdas);
    for (int k = 0; k < 4; ++k) losses[k] += ray.losses[k] * share;
    if (!with_gradients) continue;

    const Matrix<T> grad_color_input =
        backward<T>(decoder.color, trace.color, ray.grad_color, &grad_decoder.color);
    const Matrix<T> grad_output =
        stack<T>(ray.grad_tsdf.matrix(), grad_color_input.bottomRows(spec.n_geometry));
    const Points<T> grad_w = decode_backward<T>(
        spec, model, decoder.geometry, trace, points_w, grad_output, grad_color_input.topRows(spec.n_gamma()),
        &grad_decoder.geometry, gradients.features, gradients.touched);

    // p_w = R p_c + t
    Eigen::Map<PoseGradient<T>> grad_T_wc(gradients.T_wc + frame * 12);
    grad_T_wc.template leftCols<3>() += grad_w * points_c.transpose();
    grad_T_wc.template rightCols<1>() += grad_w.rowwise().sum();
  }
}

template <typename T>
void field_track(const FieldSpec& spec, const FieldModel<T>& model, const FieldRays<T>& rays, int n_samples,
                 T band, T* residuals, T* jacobian, bool* valid) {
  const Decoder<T> decoder(const_cast<T*>(model.decoder), spec);
  const T truncation = T(spec.truncation);
  const Eigen::Map<const Pose<T>> T_wc(rays.T_wc);
  const Matrix3<T> R = T_wc.template topLeftCorner<3, 3>();
  const Vector3<T> t = T_wc.template topRightCorner<3, 1>();
  const Matrix<T> no_gamma = Matrix<T>::Zero(spec.n_gamma(), n_samples);
  Matrix<T> only_tsdf = Matrix<T>::Zero(1 + spec.n_geometry, n_samples);
  only_tsdf.row(0).setOnes();

  Row<T> z(n_samples);
  for (int64_t r = 0; r < rays.n_rays; ++r) {
    const int64_t first = r * n_samples;
    ray_sample(rays.depth + r, rays.uniforms + first, 1, 0, n_samples, T(0), T(0), band, z.data());
    const Vector3<T> dir_c = Eigen::Map<const Vector3<T>>(rays.dirs_c + r * 3);
    const Points<T> points_c = dir_c * z.matrix();
    const Points<T> points_w = (R * points_c).colwise() + t;
    const FieldTrace<T> trace = decode(spec, model, decoder, points_w, false, valid + first);
    Eigen::Map<Row<T>>(residuals + first, n_samples) = z + truncation * trace.tsdf() - rays.depth[r];

    // dp_w = R (rho + phi x p_c), so ds = ds/dp_w . R (rho + phi x p_c) = h . rho + (p_c x h) . phi.
    const Points<T> grad_w = decode_backward<T>(spec, model, decoder.geometry, trace, points_w, only_tsdf,
                                                no_gamma, nullptr, nullptr, nullptr);
    const Points<T> h = truncation * (R.transpose() * grad_w);
    for (int k = 0; k < n_samples; ++k) {
      Eigen::Map<Eigen::Matrix<T, 6, 1>> row(jacobian + (first + k) * 6);
      row << h.col(k), Vector3<T>(points_c.col(k)).cross(Vector3<T>(h.col(k)));
    }
  }
}

template <typename T>
void field_query(const FieldSpec& spec, const FieldModel<T>& model, const T* points, int64_t n_points,
                 T* tsdf, T* color, bool* valid) {
  constexpr int64_t kBlock = 256;
  const Decoder<T> decoder(const_cast<T*>(model.decoder), spec);
  for (int64_t first = 0; first < n_points; first += kBlock) {
    const int64_t n = std::min(kBlock, n_points - first);
    const Points<T> x = Eigen::Map<const Points<T>>(points + first * 3, 3, n);
    const FieldTrace<T> trace = decode(spec, model, decoder, x, color != nullptr, valid + first);
    Eigen::Map<Row<T>>(tsdf + first, n) = trace.tsdf();
    if (color) {
      Eigen::Map<Points<T>> out(color + first * 3, 3, n);
      out = (1 + (-trace.color.output.array()).exp()).inverse();
    }
  }
}

#define SNH_INSTANTIATE(T)                                                                                  \
  template void field_map<T>(const FieldSpec&, const FieldModel<T>&, const FieldRays<T>&,                   \
                             const FieldSampling&, const T[4], const FieldGradients<T>&, T[4]);             \
  template void field_track<T>(const FieldSpec&, const FieldModel<T>&, const FieldRays<T>&, int, T, T*, T*, \
                               bool*);                                                                      \
  template void field_query<T>(const FieldSpec&, const FieldModel<T>&, const T*, int64_t, T*, T*, bool*);
SNH_INSTANTIATE(float)
SNH_INSTANTIATE(double)
#undef SNH_INSTANTIATE

}  // namespace snh::cpu
