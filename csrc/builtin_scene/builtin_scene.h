// A furnished room defined in code: exact z-depth, colour, mesh and signed distance, no files.
//
// World: metres, z up, floor at z = 0, the room centred on x = y = 0. A room is a union of solids (boxes, cylinders,
// spheres) inside six slabs, so every ray from inside hits. Light is a function of surface point and normal only, never
// of the view: ambient light with occlusion, and two lamps with soft shadows.
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

#include "common/parallel.h"

namespace snh::builtin {

using Vec = Eigen::Vector3d;
using Mat = Eigen::Matrix3d;

// Colours are reflectances, 0..1, as a screen shows them (gamma 2).
enum class Pattern {
  plain,
  plaster,
  wood,
  planks,
  checker,
  stripes,
  carpet,
  fabric,
  wallpaper,
  picture,
  window,
  book,
  parcel
};

struct Material {
  Pattern pattern = Pattern::plain;
  Vec a = Vec(0.8, 0.8, 0.8);  // main colour
  Vec b = Vec(0.6, 0.6, 0.6);  // second colour
  double scale = 0.1;          // m, size of the pattern's features
  uint32_t seed = 0;
  bool glows = false;  // shown as is, not lit
};

enum class Shape { box, cylinder, sphere };

// Local frame: centre at zero, a cylinder's axis is z. half: half extents, for a cylinder (radius, radius, half
// height), for a sphere three times the radius.
struct Solid {
  Shape shape;
  Mat R_ws;
  Vec center;
  Vec half;
  double radius;  // of the bounding sphere
  Material material;
};

struct Lamp {
  Vec position;
  Vec color;        // power at 1 m
  double softness;  // of its shadows: width of the half shadow per metre behind the edge
};

// Point on a solid's surface, for shading: position and normal in the world and on the surface in metres.
struct Surface {
  Vec point, normal;
  double u, v;            // m, along the face
  double half_u, half_v;  // m, half extents of the face
  int face;               // 0, 1, 2: across that axis of a box, cap of a cylinder (2); 3: curved
};

// What arrives at a point of a surface, 0..1: ambient light (1 = open) and each lamp (1 = lit).
struct Light {
  double ambient;
  std::array<double, 2> lamps;
};

// Distance to the nearest solid and share of each lamp that arrives, on a grid over the room.
class LightVolume {
 public:
  void build(const struct Room& room);
  Light at(const Vec& point, const Vec& normal) const;

 private:
  Eigen::Vector4f interpolate(const Vec& point) const;
  Vec low_;
  Eigen::Array3i n_;                    // nodes along each axis
  Eigen::Array4f last_;                 // highest position in cells, just below the last node
  std::vector<Eigen::Vector4f> nodes_;  // distance in metres, lamp 0, lamp 1, unused
};

struct Room {
  Vec low, high;  // inside of walls, floor and ceiling
  std::vector<Solid> solids;
  std::array<Lamp, 2> lamps;
  LightVolume light;

  // Signed distance in metres to the union of all solids, negative inside one; exact outside.
  double distance(const Vec& point) const;
};

// 0: living room, 1: study with a bed. Any other number throws std::invalid_argument.
Room make_room(int number);

struct Pinhole {
  int width, height;
  double fx, fy, cx, cy;
};

// T_wc: row-major 4x4, camera to world (x right, y down, z forward). rgb [H, W, 3], depth [H, W] z-depth in metres.
// Depth is that of the ray through the pixel's centre; the colour of pixels on outlines is the mean of four rays.
void render(const Room& room, const Pinhole& camera, const double* T_wc, uint8_t* rgb, float* depth,
            const ParallelFor& parallel_for);

// z-depth along one ray (depth where the direction has length 1 in z of its camera) of a solid, infinity on a miss.
// The origin is outside the solid.
double intersect(Shape shape, const Vec& half, const Vec& origin_s, const Vec& direction_s);

// Shape, position on the face and outward normal at a point of the surface.
Surface surface_at(const Solid& solid, const Vec& point);

// Reflectance (gamma 2, 0..1) averaged over `width` metres.
Vec reflectance(const Material& material, const Surface& surface, double width);

struct Mesh {
  std::vector<Eigen::Vector3f> vertices;
  std::vector<Eigen::Vector3i> faces;  // counter-clockwise seen from free space
};

// Surface that adjoins the room's free space, within 1 mm of the solids, edges at most `edge` metres long along flat
// directions. Faces buried in other solids or outside the room are left out.
Mesh make_mesh(const Room& room, double edge);

}  // namespace snh::builtin
