#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <functional>

#include "builtin_scene/builtin_scene.h"

namespace snh::builtin {
namespace {

constexpr double kSagitta = 4e-4;  // m, of chords of curved parts
constexpr double kNudge = 2e-3;    // m, how far in front of a face the space must be free

int pieces(double length, double edge) { return std::max(1, static_cast<int>(std::ceil(length / edge))); }

// Segments of a full circle whose chords stay within kSagitta.
int segments(double radius) {
  return std::max(12, static_cast<int>(std::ceil(M_PI / std::acos(1 - std::min(0.5, kSagitta / radius)))));
}

class Tessellator {
 public:
  Tessellator(const Room& room, Mesh& mesh) : room_(room), mesh_(mesh) {}

  // n x m quads of a map of the unit square into the solid's frame; counter-clockwise from outside when
  // d/ds x d/dt points out.
  void patch(const Solid& solid, int n, int m, const std::function<Vec(double, double)>& position) {
    std::vector<int> index(static_cast<size_t>(n + 1) * (m + 1), -1);
    const auto world = [&](int i, int j) {
      return Vec(solid.center +
                 solid.R_ws * position(static_cast<double>(i) / n, static_cast<double>(j) / m));
    };
    const auto triangle = [&](const std::array<std::array<int, 2>, 3>& corner) {
      std::array<Vec, 3> p;
      for (int k = 0; k < 3; ++k) p[k] = world(corner[k][0], corner[k][1]);
      if (!adjoins_free_space(p)) return;
      Eigen::Vector3i face;
      for (int k = 0; k < 3; ++k) {
        int& vertex = index[static_cast<size_t>(corner[k][0]) * (m + 1) + corner[k][1]];
        if (vertex < 0)
          vertex = static_cast<int>(mesh_.vertices.size()), mesh_.vertices.push_back(p[k].cast<float>());
        face[k] = vertex;
      }
      mesh_.faces.push_back(face);
    };
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < m; ++j) {
        triangle({{{i, j}, {i + 1, j}, {i + 1, j + 1}}});
        triangle({{{i, j}, {i + 1, j + 1}, {i, j + 1}}});
      }
  }

 private:
  // Some point just in front of the triangle is inside the room and in no solid.
  bool adjoins_free_space(const std::array<Vec, 3>& p) const {
    const Vec normal = (p[1] - p[0]).cross(p[2] - p[0]);
    if (normal.norm() < 1e-12) return false;  // at the poles of spheres and the centres of caps
    const Vec middle = (p[0] + p[1] + p[2]) / 3, ahead = normal.normalized() * kNudge;
    if (free(middle + ahead)) return true;
    return std::any_of(p.begin(), p.end(),
                       [&](const Vec& q) { return free(q + (middle - q) * 0.02 + ahead); });
  }

  bool free(const Vec& q) const {
    return (q.array() > room_.low.array()).all() && (q.array() < room_.high.array()).all() &&
           room_.distance(q) > 0;
  }

  const Room& room_;
  Mesh& mesh_;
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
