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

// Where a solid's bounding box lies in the image.
struct Extent {
  int u0, u1, v0, v1;  // first and last column and row, empty if last < first
  std::array<std::array<Eigen::Vector2d, 2>, 12> edges;  // in pixels
  bool cut;        // reaches behind the camera: the edges do not bound it
  double nearest;  // least z-depth
};

struct View {
  const Room& room;
  const Pinhole& camera;
  Mat R_wc;
  Vec origin;
  std::vector<LocalView> local;
  std::vector<Extent> extents;
  std::vector<int> order;  // solids by nearest depth

  Vec direction_c(double u, double v) const {
    return Vec((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1);
  }
};

// Pixels that can see a solid: the projection of the part of its bounding box in front of the camera.
Extent make_extent(const Pinhole& camera, const LocalView& view, const Vec& half) {
  constexpr double kNear = 0.02;  // m
  std::array<Vec, 8> corner;
  for (int k = 0; k < 8; ++k) {
    const Vec p(k & 1 ? half[0] : -half[0], k & 2 ? half[1] : -half[1], k & 4 ? half[2] : -half[2]);
    corner[k] = view.R_sc.transpose() * (p - view.origin);
  }
  Extent extent{camera.width, -1, camera.height, -1, {}, false, kInfinity};
  int n = 0;
  for (int k = 0; k < 8; ++k) {
    extent.nearest = std::min(extent.nearest, corner[k][2]);
    for (int bit = 1; bit < 8; bit *= 2) {
      if (k & bit) continue;
      std::array<Vec, 2> end{corner[k], corner[k | bit]};
      if (end[0][2] < end[1][2]) std::swap(end[0], end[1]);
      if (end[0][2] < kNear) continue;
      if (end[1][2] < kNear) {
        end[1] += (end[0] - end[1]) * ((kNear - end[1][2]) / (end[0][2] - end[1][2]));
        extent.cut = true;
      }
      for (int side = 0; side < 2; ++side) {
        const Vec& q = end[side];
        const double u = q[0] / q[2] * camera.fx + camera.cx, v = q[1] / q[2] * camera.fy + camera.cy;
        extent.edges[n][side] = Eigen::Vector2d(u, v);
        const double right = camera.width, below = camera.height;
        extent.u0 = std::min(extent.u0, static_cast<int>(std::clamp(std::floor(u), 0.0, right)));
        extent.u1 = std::max(extent.u1, static_cast<int>(std::clamp(std::ceil(u), -1.0, right - 1)));
        extent.v0 = std::min(extent.v0, static_cast<int>(std::clamp(std::floor(v), 0.0, below)));
        extent.v1 = std::max(extent.v1, static_cast<int>(std::clamp(std::ceil(v), -1.0, below - 1)));
      }
      ++n;
    }
  }
  return extent;
}

// First and last column of row v inside the box's outline, one more on each side against rounding.
std::array<int, 2> columns(const Extent& extent, int v) {
  if (extent.cut) return {extent.u0, extent.u1};
  double first = kInfinity, last = -kInfinity;
  for (const auto& [a, b] : extent.edges) {
    if ((a[1] < v && b[1] < v) || (a[1] > v && b[1] > v)) continue;
    const double rise = b[1] - a[1], t = rise != 0 ? (v - a[1]) / rise : 0;
    const double u = a[0] + t * (b[0] - a[0]), other = rise != 0 ? u : b[0];
    first = std::min({first, u, other});
    last = std::max({last, u, other});
  }
  if (first > last) return {0, -1};
  return {static_cast<int>(std::max<double>(extent.u0, first - 1)),
          static_cast<int>(std::min<double>(extent.u1, last + 1))};
}

View make_view(const Room& room, const Pinhole& camera, const double* T_wc) {
  const auto T = Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(T_wc);
  View view{room, camera, T.topLeftCorner<3, 3>(), T.topRightCorner<3, 1>(), {}, {}, {}};
  for (const Solid& solid : room.solids) {
    const LocalView local{solid.R_ws.transpose() * (view.origin - solid.center),
                          solid.R_ws.transpose() * view.R_wc};
    view.order.push_back(static_cast<int>(view.order.size()));
    view.local.push_back(local);
    view.extents.push_back(make_extent(camera, local, solid.half));
  }
  std::stable_sort(view.order.begin(), view.order.end(),
                   [&](int a, int b) { return view.extents[a].nearest < view.extents[b].nearest; });
  return view;
}

// Nearest solid of each pixel of rows [begin, end), one solid at a time.
template <double (*enter)(const Vec&, const Vec&, const Vec&)>
void cast_solid(const View& view, int number, int begin, int end, float* depth, int* seen) {
  const Pinhole& camera = view.camera;
  const LocalView local = view.local[number];
  const Extent& extent = view.extents[number];
  const Vec half = view.room.solids[number].half;
  const Vec step = local.R_sc.col(0) / camera.fx;
  for (int v = std::max(extent.v0, begin); v <= std::min(extent.v1, end - 1); ++v) {
    const Vec row = local.R_sc * view.direction_c(0, v);
    const auto [first, last] = columns(extent, v);
    for (int u = first; u <= last; ++u) {
      const int64_t pixel = static_cast<int64_t>(v) * camera.width + u;
      if (depth[pixel] <= extent.nearest) continue;
      const float z = static_cast<float>(enter(half, local.origin, row + step * u));
      if (z < depth[pixel]) depth[pixel] = z, seen[pixel] = number;
    }
  }
}

void cast_rows(const View& view, int begin, int end, float* depth, int* seen) {
  const int64_t width = view.camera.width;
  std::fill(depth + begin * width, depth + end * width, std::numeric_limits<float>::infinity());
  std::fill(seen + begin * width, seen + end * width, -1);
  for (const int number : view.order) {
    switch (view.room.solids[number].shape) {
      case Shape::box:
        cast_solid<enter_box>(view, number, begin, end, depth, seen);
        break;
      case Shape::cylinder:
        cast_solid<enter_cylinder>(view, number, begin, end, depth, seen);
        break;
      case Shape::sphere:
        cast_solid<enter_sphere>(view, number, begin, end, depth, seen);
        break;
    }
  }
}

// Light that a surface sends out, linear: reflectance x (ambient light, less where things are near, + lamps with
// distance, angle and shadow). width: of the pixel on the surface, m.
Vec radiance(const Room& room, const Material& material, const Surface& surface, double width) {
  const Vec gamma = reflectance(material, surface, width);
  const Vec linear = gamma.cwiseProduct(gamma);
  if (material.glows) return linear;
  const double upward = 0.5 + 0.5 * surface.normal[2];
  const Light arriving = room.light.at(surface.point, surface.normal);
  Vec light = (Vec(0.42, 0.38, 0.34) * (1 - upward) + Vec(0.46, 0.46, 0.47) * upward) * arriving.ambient;
  for (int k = 0; k < 2; ++k) {
    const Vec toward = room.lamps[k].position - surface.point;
    const double along = surface.normal.dot(toward), distance2 = toward.squaredNorm();
    if (along > 0)
      light += room.lamps[k].color * (along / std::sqrt(distance2) / (1 + distance2) * arriving.lamps[k]);
  }
  return linear.cwiseProduct(light);
}

// Linear light to a screen's 0..255: a soft shoulder that reaches white at 2, then gamma 2.
Eigen::Array4f screen_color(const Vec& linear) {
  Eigen::Array4f x;
  x << linear.cast<float>().array() * 1.25f, 0;
  return (x * (1 + x * 0.16f) / (1 + x * 0.55f)).min(1).sqrt() * 255;
}

Eigen::Array4f shade(const View& view, const Solid& solid, const Surface& surface, double z) {
  return screen_color(radiance(view.room, solid.material, surface, z / view.camera.fx));
}

void store(const Eigen::Array4f& color, uint8_t* rgb) {
  for (int c = 0; c < 3; ++c) rgb[c] = static_cast<uint8_t>(color[c] + 0.5f);
}

// Colour of each pixel's centre; the number of the solid in `seen` becomes 4 x number + face.
void shade_rows(const View& view, int begin, int end, float* depth, int* seen, uint8_t* rgb) {
  for (int v = begin; v < end; ++v)
    for (int u = 0; u < view.camera.width; ++u) {
      const int64_t pixel = static_cast<int64_t>(v) * view.camera.width + u;
      if (seen[pixel] < 0) {
        depth[pixel] = 0;
        store(Eigen::Array4f::Zero(), rgb + 3 * pixel);
        continue;
      }
      const Solid& solid = view.room.solids[seen[pixel]];
      const Surface surface =
          surface_at(solid, view.origin + view.R_wc * view.direction_c(u, v) * depth[pixel]);
      store(shade(view, solid, surface, depth[pixel]), rgb + 3 * pixel);
      seen[pixel] = 4 * seen[pixel] + surface.face;
    }
}

// Solids that a pixel and its eight neighbours see, each once; none unless two of them see different faces.
int solids_at_outline(const View& view, const int* seen, int u, int v, std::array<int, 9>& found) {
  const int width = view.camera.width;
  const int64_t pixel = static_cast<int64_t>(v) * width + u;
  const int u0 = std::max(u - 1, 0), u1 = std::min(u + 1, width - 1);
  const int v0 = std::max(v - 1, 0), v1 = std::min(v + 1, view.camera.height - 1);
  if (seen[pixel - u + u0] == seen[pixel] && seen[pixel - u + u1] == seen[pixel] &&
      seen[static_cast<int64_t>(v0) * width + u] == seen[pixel] &&
      seen[static_cast<int64_t>(v1) * width + u] == seen[pixel])
    return 0;
  int n = 0;
  for (int y = v0; y <= v1; ++y)
    for (int x = u0; x <= u1; ++x) {
      const int value = seen[static_cast<int64_t>(y) * width + x];
      if (value >= 0 && std::find(found.begin(), found.begin() + n, value / 4) == found.begin() + n)
        found[n++] = value / 4;
    }
  return n;
}

// Colour along one ray against a few solids; false if it hits none of them.
bool shade_ray(const View& view, const std::array<int, 9>& solids, int n, const Vec& direction_c,
               Eigen::Array4f& color) {
  double z = kInfinity;
  int nearest = -1;
  for (int k = 0; k < n; ++k) {
    const LocalView& local = view.local[solids[k]];
    const Solid& solid = view.room.solids[solids[k]];
    const double found = intersect(solid.shape, solid.half, local.origin, local.R_sc * direction_c);
    if (found < z) z = found, nearest = solids[k];
  }
  if (nearest < 0) return false;
  const Solid& solid = view.room.solids[nearest];
  color = shade(view, solid, surface_at(solid, view.origin + view.R_wc * direction_c * z), z);
  return true;
}

// Pixels on outlines become the mean of four rays, cast against what their neighbours see.
void smooth_rows(const View& view, int begin, int end, const int* seen, uint8_t* rgb) {
  std::array<int, 9> solids;
  for (int v = begin; v < end; ++v)
    for (int u = 0; u < view.camera.width; ++u) {
      const int n = solids_at_outline(view, seen, u, v, solids);
      Eigen::Array4f sum = Eigen::Array4f::Zero(), color;
      int hits = 0;
      for (int part = 0; n > 0 && part < 4; ++part) {
        const Vec d = view.direction_c(u + (part & 1 ? 0.25 : -0.25), v + (part & 2 ? 0.25 : -0.25));
        if (!shade_ray(view, solids, n, d, color)) continue;
        sum += color;
        ++hits;
      }
      if (hits > 0)
        store(sum / static_cast<float>(hits), rgb + 3 * (static_cast<int64_t>(v) * view.camera.width + u));
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
    const double reach = nearest + solid.radius;
    if ((point - solid.center).squaredNorm() > reach * reach) continue;  // its bounding sphere is farther
    nearest = std::min(nearest, solid_distance(solid, point));
  }
  return nearest;
}

Surface surface_at(const Solid& solid, const Vec& point) {
  const Vec p = solid.R_ws.transpose() * (point - solid.center);
  const Vec& h = solid.half;
  if (solid.shape == Shape::sphere) {
    const double r = h[0];
    return {point, solid.R_ws * p / r, std::atan2(p[1], p[0]) * r, p[2], M_PI * r, r, 3};
  }
  if (solid.shape == Shape::cylinder && h[2] - std::abs(p[2]) > h[0] - std::sqrt(p[0] * p[0] + p[1] * p[1])) {
    const Vec normal = solid.R_ws * Vec(p[0], p[1], 0).normalized();
    return {point, normal, std::atan2(p[1], p[0]) * h[0], p[2], M_PI * h[0], h[2], 3};
  }
  int axis = 2;
  if (solid.shape == Shape::box) (h - p.cwiseAbs()).minCoeff(&axis);  // the face is where the margin is least
  const int along = axis == 0 ? 1 : 0, across = axis == 2 ? 1 : 2;
  const Vec normal = solid.R_ws.col(axis) * (p[axis] < 0 ? -1 : 1);
  return {point, normal, p[along], p[across], h[along], h[across], axis};
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
