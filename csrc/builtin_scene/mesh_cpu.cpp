#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <map>

#include "builtin_scene/builtin_scene.h"

namespace snh::builtin {
namespace {

constexpr double kSagitta = 4e-4;   // m, of chords of curved parts
constexpr double kNudge = 2e-3;     // m, how far in front of a face the space must be free
constexpr double kSmallest = 0.01;  // m, size at which half buried triangles are split no further

int pieces(double length, double edge) { return std::max(1, static_cast<int>(std::ceil(length / edge))); }

// Segments of a full circle whose chords stay within kSagitta.
int segments(double radius) {
  return std::max(12, static_cast<int>(std::ceil(M_PI / std::acos(1 - std::min(0.5, kSagitta / radius)))));
}

using Triangle = std::array<Vec, 3>;

class Tessellator {
 public:
  Tessellator(const Room& room, Mesh& mesh) : room_(room), mesh_(mesh) {}

  // n x m quads of a map of the unit square into the solid's frame; counter-clockwise from outside when
  // d/ds x d/dt points out.
  void patch(const Solid& solid, int n, int m, const std::function<Vec(double, double)>& position) {
    shared_.clear();
    const auto world = [&](int i, int j) {
      return Vec(solid.center +
                 solid.R_ws * position(static_cast<double>(i) / n, static_cast<double>(j) / m));
    };
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < m; ++j) {
        const Vec a = world(i, j), b = world(i + 1, j), c = world(i + 1, j + 1), d = world(i, j + 1);
        add({a, b, c});
        add({a, c, d});
      }
  }

 private:
  // Keeps a triangle in front of which the space is free, drops a buried one, and splits one that is half buried
  // until its parts are small.
  void add(const Triangle& p) {
    const Vec normal = (p[1] - p[0]).cross(p[2] - p[0]);
    if (normal.norm() < 1e-12) return;  // at the poles of spheres and the centres of caps
    const Vec middle = (p[0] + p[1] + p[2]) / 3, ahead = normal.normalized() * kNudge;
    int n_free = free(middle + ahead);
    for (const Vec& corner : p) n_free += free(corner + (middle - corner) * 0.02 + ahead);
    if (n_free == 0) return;
    if (n_free == 4 || normal.norm() < kSmallest * kSmallest) return keep(p);
    const Vec ab = (p[0] + p[1]) / 2, bc = (p[1] + p[2]) / 2, ca = (p[2] + p[0]) / 2;
    add({p[0], ab, ca});
    add({ab, p[1], bc});
    add({ca, bc, p[2]});
    add({ab, bc, ca});
  }

  void keep(const Triangle& p) {
    Eigen::Vector3i face;
    for (int k = 0; k < 3; ++k) {
      const Eigen::Vector3f position = p[k].cast<float>();
      const auto [found, is_new] = shared_.try_emplace({position[0], position[1], position[2]},
                                                       static_cast<int>(mesh_.vertices.size()));
      if (is_new) mesh_.vertices.push_back(position);
      face[k] = found->second;
    }
    mesh_.faces.push_back(face);
  }

  bool free(const Vec& q) const {
    return (q.array() > room_.low.array()).all() && (q.array() < room_.high.array()).all() &&
           room_.distance(q) > 0;
  }

  const Room& room_;
  Mesh& mesh_;
  std::map<std::array<float, 3>, int> shared_;  // vertices of the patch in hand, by position
};

void add_box(Tessellator& out, const Solid& solid, double edge) {
  const Vec& h = solid.half;
  for (int axis = 0; axis < 3; ++axis)
    for (const double side : {-1.0, 1.0}) {
      const int s = (axis + 1) % 3, t = (axis + 2) % 3;
      out.patch(solid, pieces(2 * h[s], edge), pieces(2 * h[t], edge), [&](double a, double b) {
        Vec p;
        p[axis] = side * h[axis];
        p[s] = (2 * a - 1) * h[s] * side;  // mirrored on the far side, so that it faces outward
        p[t] = (2 * b - 1) * h[t];
        return p;
      });
    }
}

void add_cylinder(Tessellator& out, const Solid& solid, double edge) {
  const double r = solid.half[0], h = solid.half[2];
  const int n = segments(r);
  const auto around = [n](double a) { return 2 * M_PI * std::round(a * n) / n; };
  out.patch(solid, n, pieces(2 * h, edge), [&](double a, double b) {
    return Vec(r * std::cos(around(a)), r * std::sin(around(a)), (2 * b - 1) * h);
  });
  for (const double side : {-1.0, 1.0})
    out.patch(solid, pieces(r, edge), n, [&](double a, double b) {
      return Vec(a * r * std::cos(around(b)), side * a * r * std::sin(around(b)), side * h);
    });
}

void add_sphere(Tessellator& out, const Solid& solid) {
  const double r = solid.half[0];
  const int n = segments(r), m = n / 2;
  out.patch(solid, n, m, [&](double a, double b) {
    const double longitude = 2 * M_PI * a, latitude = M_PI * (b - 0.5);
    return Vec(r * std::cos(latitude) * std::cos(longitude), r * std::cos(latitude) * std::sin(longitude),
               r * std::sin(latitude));
  });
}

}  // namespace

Mesh make_mesh(const Room& room, double edge) {
  Mesh mesh;
  Tessellator out(room, mesh);
  for (const Solid& solid : room.solids) {
    switch (solid.shape) {
      case Shape::box:
        add_box(out, solid, edge);
        break;
      case Shape::cylinder:
        add_cylinder(out, solid, edge);
        break;
      case Shape::sphere:
        add_sphere(out, solid);
        break;
    }
  }
  return mesh;
}

}  // namespace snh::builtin
