#include "builtin_scene/builtin_scene.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace snh::builtin {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

// The slabs between which the ray lies inside the box; it enters at the last of the three entries.
inline double enter_box(const Vec& half, const Vec& o, const Vec& d) {
  double enter = 0, leave = kInfinity;
  for (int k = 0; k < 3; ++k) {
    const double inverse = 1 / d[k];
    const double middle = -o[k] * inverse, reach = std::abs(half[k] * inverse);
    enter = std::max(enter, middle - reach);
    leave = std::min(leave, middle + reach);
  }
  return enter > 0 && enter <= leave ? enter : kInfinity;
}

// Roots of |o + t d|^2 = r^2; half of b to save factors of two.
inline double enter_sphere(const Vec& half, const Vec& o, const Vec& d) {
  const double a = d.squaredNorm(), b = o.dot(d), c = o.squaredNorm() - half[0] * half[0];
  const double discriminant = b * b - a * c;
  if (b >= 0 || discriminant < 0) return kInfinity;
  return (-b - std::sqrt(discriminant)) / a;
}

// Intersection of the infinite cylinder's interval with the slab between the caps.
inline double enter_cylinder(const Vec& half, const Vec& o, const Vec& d) {
  const double a = d[0] * d[0] + d[1] * d[1], b = o[0] * d[0] + o[1] * d[1];
  const double c = o[0] * o[0] + o[1] * o[1] - half[0] * half[0];
  double enter = 0, leave = kInfinity;
  if (a > 0) {
    const double discriminant = b * b - a * c;
    if (discriminant < 0) return kInfinity;
    const double root = std::sqrt(discriminant);
    enter = (-b - root) / a;
    leave = (-b + root) / a;
  } else if (c > 0) {
    return kInfinity;
  }
  const double middle = -o[2] / d[2], reach = std::abs(half[2] / d[2]);
  enter = std::max(enter, middle - reach);
  leave = std::min(leave, middle + reach);
  return enter > 0 && enter <= leave ? enter : kInfinity;
}

double solid_distance(const Solid& solid, const Vec& point) {
  const Vec p = solid.R_ws.transpose() * (point - solid.center);
  if (solid.shape == Shape::sphere) return p.norm() - solid.half[0];
  if (solid.shape == Shape::box) {
    const Vec q = p.cwiseAbs() - solid.half;
    return q.cwiseMax(0).norm() + std::min(q.maxCoeff(), 0.0);
  }
  const double side = std::hypot(p[0], p[1]) - solid.half[0], cap = std::abs(p[2]) - solid.half[2];
  return std::hypot(std::max(side, 0.0), std::max(cap, 0.0)) + std::min(std::max(side, cap), 0.0);
}

// A camera pose seen from a solid: where the rays start and how pixel directions (x, y, 1) turn into its frame.
struct LocalView {
  Vec origin;
  Mat R_sc;
};

struct View {
  const Room& room;
  const Pinhole& camera;
  Mat R_wc;
  Vec origin;
  std::vector<LocalView> local;
  std::vector<std::array<int, 4>> bounds;  // per solid: first and last column, first and last row

  Vec direction_c(double u, double v) const {
    return Vec((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1);
  }
};

// Pixels that can see a solid: those inside the projection of its bounding box, all of them if it reaches behind.
std::array<int, 4> screen_bounds(const Pinhole& camera, const LocalView& view, const Vec& half) {
  double u0 = kInfinity, u1 = -kInfinity, v0 = kInfinity, v1 = -kInfinity;
  for (int corner = 0; corner < 8; ++corner) {
    const Vec p(corner & 1 ? half[0] : -half[0], corner & 2 ? half[1] : -half[1],
                corner & 4 ? half[2] : -half[2]);
    const Vec q = view.R_sc.transpose() * (p - view.origin);
    if (q[2] < 0.01) return {0, camera.width - 1, 0, camera.height - 1};
    const double u = q[0] / q[2] * camera.fx + camera.cx, v = q[1] / q[2] * camera.fy + camera.cy;
    u0 = std::min(u0, u), u1 = std::max(u1, u), v0 = std::min(v0, v), v1 = std::max(v1, v);
  }
  const auto first = [](double x, int n) {
    return static_cast<int>(std::clamp(std::floor(x), 0.0, n + 0.0));
  };
  const auto last = [](double x, int n) { return static_cast<int>(std::clamp(std::ceil(x), -1.0, n - 1.0)); };
  return {first(u0, camera.width), last(u1, camera.width), first(v0, camera.height), last(v1, camera.height)};
}

bool behind(const LocalView& view, const Vec& half) {
  const Vec forward = view.R_sc.col(2);
  return forward.dot(-view.origin) + forward.cwiseAbs().dot(half) <= 0;
}

View make_view(const Room& room, const Pinhole& camera, const double* T_wc) {
  const auto T = Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(T_wc);
  View view{room, camera, T.topLeftCorner<3, 3>(), T.topRightCorner<3, 1>(), {}, {}};
  for (const Solid& solid : room.solids) {
    const LocalView local{solid.R_ws.transpose() * (view.origin - solid.center),
                          solid.R_ws.transpose() * view.R_wc};
    view.local.push_back(local);
    view.bounds.push_back(behind(local, solid.half) ? std::array<int, 4>{0, -1, 0, -1}
                                                    : screen_bounds(camera, local, solid.half));
  }
  return view;
}

// Nearest solid of each pixel of rows [begin, end), one solid at a time.
template <double (*enter)(const Vec&, const Vec&, const Vec&)>
void cast_solid(const View& view, int number, int begin, int end, float* depth, int* seen) {
  const Pinhole& camera = view.camera;
  const LocalView& local = view.local[number];
  const Vec half = view.room.solids[number].half;
  const auto [u0, u1, v0, v1] = view.bounds[number];
  for (int v = std::max(v0, begin); v <= std::min(v1, end - 1); ++v) {
    const Vec row = local.R_sc.col(2) + local.R_sc.col(1) * ((v - camera.cy) / camera.fy);
    for (int u = u0; u <= u1; ++u) {
      const Vec d = row + local.R_sc.col(0) * ((u - camera.cx) / camera.fx);
      const float z = static_cast<float>(enter(half, local.origin, d));
      const int64_t pixel = static_cast<int64_t>(v) * camera.width + u;
      if (z < depth[pixel]) depth[pixel] = z, seen[pixel] = number;
    }
  }
}

void cast_rows(const View& view, int begin, int end, float* depth, int* seen) {
  const int64_t width = view.camera.width;
  std::fill(depth + begin * width, depth + end * width, std::numeric_limits<float>::infinity());
  std::fill(seen + begin * width, seen + end * width, -1);
  for (int k = 0; k < static_cast<int>(view.room.solids.size()); ++k) {
    switch (view.room.solids[k].shape) {
      case Shape::box:
        cast_solid<enter_box>(view, k, begin, end, depth, seen);
        break;
      case Shape::cylinder:
        cast_solid<enter_cylinder>(view, k, begin, end, depth, seen);
        break;
      case Shape::sphere:
        cast_solid<enter_sphere>(view, k, begin, end, depth, seen);
        break;
    }
  }
}

// Light that a point of a solid sends out, linear: reflectance x (ambient light, less where things are near, bluish
// from above and brownish from below, + lamps with distance, angle and shadow).
Vec radiance(const Room& room, const Solid& solid, const Vec& point, double z, double pixel) {
  const Surface surface = surface_at(solid, point);
  const Vec shown = reflectance(solid.material, surface, z * pixel);
  const Vec linear = shown.cwiseProduct(shown);
  if (solid.material.glows) return linear;
  const double upward = 0.5 + 0.5 * surface.normal[2];
  Vec light = (Vec(0.30, 0.27, 0.24) * (1 - upward) + Vec(0.36, 0.37, 0.39) * upward) *
              room.light.ambient(point, surface.normal);
  for (int k = 0; k < 2; ++k) {
    const Vec toward = room.lamps[k].position - point;
    const double cosine = surface.normal.dot(toward) / toward.norm();
    if (cosine <= 0) continue;
    const double share = cosine / (0.6 + toward.squaredNorm()) * room.light.lamp(k, point, surface.normal);
    light += room.lamps[k].color * share;
  }
  return linear.cwiseProduct(light);
}

// Linear light to a screen's 0..255: a soft shoulder that reaches white at 2.5, then gamma 2.
Vec shown(const Vec& linear) {
  const Vec x = linear.cwiseMax(0) * 1.25;
  return (x.array() * (1 + x.array() / 6.25) / (1 + 0.55 * x.array())).min(1).sqrt() * 255;
}

Vec shade_ray(const View& view, int number, const Vec& direction_c, double z) {
  const Vec point = view.origin + view.R_wc * direction_c * z;
  return shown(radiance(view.room, view.room.solids[number], point, z, 1 / view.camera.fx));
}

void store(const Vec& color, uint8_t* rgb) {
  for (int c = 0; c < 3; ++c) rgb[c] = static_cast<uint8_t>(std::lround(color[c]));
}

void shade_rows(const View& view, int begin, int end, const float* depth, const int* seen, uint8_t* rgb) {
  for (int v = begin; v < end; ++v)
    for (int u = 0; u < view.camera.width; ++u) {
      const int64_t pixel = static_cast<int64_t>(v) * view.camera.width + u;
      if (seen[pixel] < 0) continue;
      store(shade_ray(view, seen[pixel], view.direction_c(u, v), depth[pixel]), rgb + 3 * pixel);
    }
}

// Solids seen by a pixel and its neighbours, each once; more than one means that an outline is near.
int seen_around(const View& view, const int* seen, int u, int v, std::array<int, 9>& found) {
  int n = 0;
  for (int y = std::max(v - 1, 0); y <= std::min(v + 1, view.camera.height - 1); ++y)
    for (int x = std::max(u - 1, 0); x <= std::min(u + 1, view.camera.width - 1); ++x) {
      const int number = seen[static_cast<int64_t>(y) * view.camera.width + x];
      if (number >= 0 && std::find(found.begin(), found.begin() + n, number) == found.begin() + n)
        found[n++] = number;
    }
  return n;
}

// Mean colour of four rays per pixel on outlines, against the solids that its neighbours see.
void smooth_rows(const View& view, int begin, int end, const int* seen, uint8_t* rgb) {
  std::array<int, 9> around;
  for (int v = begin; v < end; ++v)
    for (int u = 0; u < view.camera.width; ++u) {
      const int n = seen_around(view, seen, u, v, around);
      if (n < 2) continue;
      Vec sum = Vec::Zero();
      int hits = 0;
      for (int sub = 0; sub < 4; ++sub) {
        const Vec d = view.direction_c(u + (sub & 1 ? 0.25 : -0.25), v + (sub & 2 ? 0.25 : -0.25));
        double z = kInfinity;
        int nearest = -1;
        for (int k = 0; k < n; ++k) {
          const LocalView& local = view.local[around[k]];
          const Solid& solid = view.room.solids[around[k]];
          const double found = intersect(solid.shape, solid.half, local.origin, local.R_sc * d);
          if (found < z) z = found, nearest = around[k];
        }
        if (nearest < 0) continue;
        sum += shade_ray(view, nearest, d, z);
        ++hits;
      }
      if (hits > 0) store(sum / hits, rgb + 3 * (static_cast<int64_t>(v) * view.camera.width + u));
    }
}

}  // namespace

double intersect(Shape shape, const Vec& half, const Vec& origin_s, const Vec& direction_s) {
  switch (shape) {
    case Shape::box:
      return enter_box(half, origin_s, direction_s);
    case Shape::cylinder:
      return enter_cylinder(half, origin_s, direction_s);
    default:
      return enter_sphere(half, origin_s, direction_s);
  }
}

double Room::distance(const Vec& point) const {
  double nearest = kInfinity;
  for (const Solid& solid : solids) {
    if ((point - solid.center).norm() - solid.half.norm() > nearest)
      continue;  // its bounding sphere is farther
    nearest = std::min(nearest, solid_distance(solid, point));
  }
  return nearest;
}

Surface surface_at(const Solid& solid, const Vec& point) {
  const Vec p = solid.R_ws.transpose() * (point - solid.center);
  const Vec& h = solid.half;
  if (solid.shape == Shape::sphere) {
    const double r = h[0];
    return {point, solid.R_ws * p / r, std::atan2(p[1], p[0]) * r, p[2], M_PI * r, r};
  }
  if (solid.shape == Shape::cylinder && h[2] - std::abs(p[2]) > h[0] - std::hypot(p[0], p[1])) {
    const Vec normal = solid.R_ws * Vec(p[0], p[1], 0).normalized();
    return {point, normal, std::atan2(p[1], p[0]) * h[0], p[2], M_PI * h[0], h[2]};
  }
  int axis = 2;
  if (solid.shape == Shape::box) (h - p.cwiseAbs()).minCoeff(&axis);  // the face is where the margin is least
  const int along = axis == 0 ? 1 : 0, across = axis == 2 ? 1 : 2;
  const Vec normal = solid.R_ws.col(axis) * (p[axis] < 0 ? -1 : 1);
  return {point, normal, p[along], p[across], h[along], h[across]};
}

void render(const Room& room, const Pinhole& camera, const double* T_wc, uint8_t* rgb, float* depth,
            const ParallelFor& parallel_for) {
  const View view = make_view(room, camera, T_wc);
  std::vector<int> seen(static_cast<size_t>(camera.width) * camera.height);
  parallel_for(camera.height, [&](int64_t begin, int64_t end) {
    cast_rows(view, static_cast<int>(begin), static_cast<int>(end), depth, seen.data());
    shade_rows(view, static_cast<int>(begin), static_cast<int>(end), depth, seen.data(), rgb);
  });
  parallel_for(camera.height, [&](int64_t begin, int64_t end) {
    smooth_rows(view, static_cast<int>(begin), static_cast<int>(end), seen.data(), rgb);
  });
}

}  // namespace snh::builtin
