// Soft light without tracing rays per pixel: distances and shadows are computed once per room on a grid.
#include <algorithm>
#include <cmath>

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
double LightVolume::at(const std::vector<float>& values, const Vec& point) const {
  int64_t base = 0;
  double f[3];
  const int64_t stride[3] = {static_cast<int64_t>(n_[1]) * n_[2], n_[2], 1};
  for (int k = 0; k < 3; ++k) {
    const double x = std::clamp((point[k] - low_[k]) / kSpacing, 0.0, n_[k] - 1.001);
    const int i = static_cast<int>(x);
    f[k] = x - i;
    base += i * stride[k];
  }
  const float* p = values.data() + base;
  const auto line = [&](int64_t o) { return p[o] + (p[o + 1] - p[o]) * f[2]; };
  const double near = line(0) + (line(stride[1]) - line(0)) * f[1];
  const double far = line(stride[0]) + (line(stride[0] + stride[1]) - line(stride[0])) * f[1];
  return near + (far - near) * f[0];
}

double LightVolume::ambient(const Vec& point, const Vec& normal) const {
  const double close = at(distance_, point + normal * 0.08) / 0.08;
  const double wide = at(distance_, point + normal * 0.40) / 0.40;
  return 0.30 + 0.30 * std::clamp(close, 0.0, 1.0) + 0.40 * std::clamp(wide, 0.0, 1.0);
}

double LightVolume::lamp(int k, const Vec& point, const Vec& normal) const {
  return at(arriving_[k], point + normal * 0.06);
}

void LightVolume::build(const Room& room) {
  low_ = room.low;
  n_ = ((room.high - room.low) / kSpacing).array().ceil().cast<int>() + 1;
  const int64_t nodes = static_cast<int64_t>(n_[0]) * n_[1] * n_[2];
  const auto node = [&](int64_t i) {
    return Vec(low_ + kSpacing * Vec(i / n_[2] / n_[1], i / n_[2] % n_[1], i % n_[2]));
  };
  distance_.resize(nodes);
  for (int64_t i = 0; i < nodes; ++i) distance_[i] = static_cast<float>(room.distance(node(i)));
  for (int k = 0; k < 2; ++k) {
    arriving_[k].resize(nodes);
    const Lamp& lamp = room.lamps[k];
    for (int64_t i = 0; i < nodes; ++i) {
      const Vec start = free_point(room, node(i), distance_[i]);
      const double length = (lamp.position - start).norm();
      const Vec direction = (lamp.position - start) / length;
      double share = 1;  // least ratio of free width to distance on the way: the half shadow
      for (double t = 0.06; t < length - kLampGap && share > 0.01;) {
        const double free = at(distance_, start + direction * t);
        share = std::min(share, 0.5 + 0.5 * free / (lamp.softness * (t + 0.1)));
        t += std::max(free, 0.04);
      }
      share = std::clamp(share, 0.0, 1.0);
      arriving_[k][i] = static_cast<float>(share * share * (3 - 2 * share));
    }
  }
}

}  // namespace snh::builtin
