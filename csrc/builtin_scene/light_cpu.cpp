// Soft light without tracing rays per pixel: distances and shadows are computed once per room on a grid.
#include <algorithm>
#include <cmath>
#include <functional>

#include "builtin_scene/builtin_scene.h"

namespace snh::builtin {
namespace {

constexpr double kSpacing = 0.05;  // m, between nodes of the grid
constexpr double kLampGap = 0.3;   // m, around a lamp's position where nothing casts a shadow (its own shade)

// Nodes inside a solid answer for the free point next to them, so that interpolation near surfaces stays bright.
Vec free_point(const Room& room, const Vec& p, double distance) {
  if (distance > 0.02) return p;
  const double step = 1e-3;
  Vec gradient;
  for (int k = 0; k < 3; ++k) {
    const Vec e = Vec::Unit(k) * step;
    gradient[k] = room.distance(p + e) - room.distance(p - e);
  }
  const double norm = gradient.norm();
  return norm > 0 ? Vec(p + gradient / norm * (0.02 - distance)) : p;
}

}  // namespace

// Trilinear; points outside the grid take its border.
Eigen::Vector4f LightVolume::interpolate(const Vec& point) const {
  Eigen::Array4f x;
  x << ((point - low_) * (1 / kSpacing)).cast<float>().array(), 0;
  x = x.max(0).min(last_);
  const Eigen::Array4i cell = x.cast<int>();
  const Eigen::Array4f f = x - cell.cast<float>();
  const int64_t stride[2] = {static_cast<int64_t>(n_[1]) * n_[2], n_[2]};
  const int64_t base = cell[0] * stride[0] + cell[1] * stride[1] + cell[2];
  const Eigen::Vector4f* p = nodes_.data() + base;
  const auto line = [&](int64_t o) -> Eigen::Vector4f { return p[o] + (p[o + 1] - p[o]) * f[2]; };
  const auto face = [&](int64_t o) -> Eigen::Vector4f {
    const Eigen::Vector4f near = line(o);
    return near + (line(o + stride[1]) - near) * f[1];
  };
  const Eigen::Vector4f near = face(0);
  return near + (face(stride[0]) - near) * f[0];
}

// Open space in front of the surface, close and wide, stands for the share of the sky that it sees.
Light LightVolume::at(const Vec& point, const Vec& normal) const {
  constexpr double kClose = 0.07, kWide = 0.40;  // m
  const Eigen::Vector4f close = interpolate(point + normal * kClose),
                        wide = interpolate(point + normal * kWide);
  const double open =
      0.4 * std::clamp(close[0] / kClose, 0.0, 1.0) + 0.6 * std::clamp(wide[0] / kWide, 0.0, 1.0);
  return {0.4 + 0.6 * open, {close[1], close[2]}};
}

namespace {

// Share of a lamp that reaches a point: the least ratio of free width to distance on the way makes the half shadow.
float arriving(const Vec& start, const Lamp& lamp, const std::function<double(const Vec&)>& free_width) {
  const double length = (lamp.position - start).norm();
  const Vec direction = (lamp.position - start) / length;
  double share = 1;
  for (double t = 0.06; t < length - kLampGap && share > 0.01;) {
    const double width = free_width(start + direction * t);
    share = std::min(share, 0.5 + 0.5 * width / (lamp.softness * (t + 0.1)));
    t += std::max(width, 0.04);
  }
  share = std::clamp(share, 0.0, 1.0);
  return static_cast<float>(share * share * (3 - 2 * share));
}

}  // namespace

void LightVolume::build(const Room& room) {
  low_ = room.low;
  n_ = ((room.high - room.low) / kSpacing).array().ceil().cast<int>() + 1;
  last_ << n_.cast<float>() - 1.001f, 0;
  nodes_.assign(static_cast<size_t>(n_[0]) * n_[1] * n_[2], Eigen::Vector4f::Zero());
  const auto position = [&](int64_t i) {
    return Vec(low_ + kSpacing * Vec(i / n_[2] / n_[1], i / n_[2] % n_[1], i % n_[2]));
  };
  const auto n = static_cast<int64_t>(nodes_.size());
  for (int64_t i = 0; i < n; ++i) nodes_[i][0] = static_cast<float>(room.distance(position(i)));
  const auto free_width = [&](const Vec& point) -> double { return interpolate(point)[0]; };
  for (int64_t i = 0; i < n; ++i) {
    const Vec start = free_point(room, position(i), nodes_[i][0]);
    for (int k = 0; k < 2; ++k) nodes_[i][1 + k] = arriving(start, room.lamps[k], free_width);
  }
}

}  // namespace snh::builtin
