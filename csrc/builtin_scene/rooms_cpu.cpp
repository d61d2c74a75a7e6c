// The furniture. Sizes and positions in metres; a piece is built in its own frame: x along its width, front toward -y.
#include <cmath>
#include <stdexcept>
#include <string>

#include "builtin_scene/builtin_scene.h"

namespace snh::builtin {
namespace {

Mat turn(double yaw_deg, double pitch_deg = 0,
         double roll_deg = 0) {  // about z, then x, then y of the turned frame
  const double a = yaw_deg * M_PI / 180, b = pitch_deg * M_PI / 180, c = roll_deg * M_PI / 180;
  Mat Z, X, Y;
  Z << std::cos(a), -std::sin(a), 0, std::sin(a), std::cos(a), 0, 0, 0, 1;
  X << 1, 0, 0, 0, std::cos(b), -std::sin(b), 0, std::sin(b), std::cos(b);
  Y << std::cos(c), 0, std::sin(c), 0, 1, 0, -std::sin(c), 0, std::cos(c);
  return Z * X * Y;
}

Material plain(double r, double g, double b) { return {Pattern::plain, Vec(r, g, b), Vec(r, g, b)}; }
Material glow(double r, double g, double b) {
  return {Pattern::plain, Vec(r, g, b), Vec(r, g, b), 0.1, 0, true};
}
Material wood(Vec a, Vec b, uint32_t seed = 0) { return {Pattern::wood, a, b, 0.08, seed}; }
Material fabric(Vec a, Vec b, uint32_t seed = 0) { return {Pattern::fabric, a, b, 0.02, seed}; }
Material leaves(uint32_t seed) {
  return {Pattern::plaster, Vec(0.22, 0.42, 0.18), Vec(0.55, 0.74, 0.36), 0.03, seed};
}

const Material kOak = wood(Vec(0.80, 0.62, 0.42), Vec(0.62, 0.43, 0.26));
const Material kWalnut = wood(Vec(0.50, 0.34, 0.24), Vec(0.33, 0.21, 0.15));
const Material kPine = wood(Vec(0.91, 0.78, 0.56), Vec(0.78, 0.60, 0.38));
const Material kWhite = plain(0.93, 0.92, 0.90);
const Material kSteel = plain(0.55, 0.56, 0.58);
const Material kBlack = plain(0.13, 0.13, 0.15);
const Material kCeramic = plain(0.90, 0.88, 0.84);

// Places solids in a frame on the floor of a room.
class Place {
 public:
  Place(Room& room, double x, double y, double yaw_deg, double z = 0)
      : room_(room), R_(turn(yaw_deg)), origin_(x, y, z) {}

  Place at(double x, double y, double yaw_deg, double z = 0) const {
    Place inner(room_, 0, 0, 0);
    inner.R_ = R_ * turn(yaw_deg);
    inner.origin_ = origin_ + R_ * Vec(x, y, z);
    return inner;
  }
  // A box stands on z with its middle at (x, y); size = full extents.
  void box(double x, double y, double z, Vec size, const Material& m, Mat tilt = Mat::Identity()) const {
    add(Shape::box, Vec(x, y, z + size[2] / 2), size / 2, m, tilt);
  }
  void cylinder(double x, double y, double z, double radius, double height, const Material& m) const {
    add(Shape::cylinder, Vec(x, y, z + height / 2), Vec(radius, radius, height / 2), m, Mat::Identity());
  }
  // Lies on its side, its axis along the turned x, its middle at (x, y, z).
  void roll(double x, double y, double z, double radius, double length, const Material& m,
            double yaw_deg = 0) const {
    add(Shape::cylinder, Vec(x, y, z), Vec(radius, radius, length / 2), m, turn(yaw_deg, 0, 90));
  }
  void sphere(double x, double y, double z, double radius, const Material& m) const {
    add(Shape::sphere, Vec(x, y, z), Vec::Constant(radius), m, Mat::Identity());
  }

 private:
  void add(Shape shape, Vec center, Vec half, const Material& m, const Mat& tilt) const {
    const double radius = shape == Shape::sphere ? half[0] : half.norm();
    room_.solids.push_back({shape, R_ * tilt, origin_ + R_ * center, half, radius, m});
  }

  Room& room_;
  Mat R_;
  Vec origin_;
};

// Six slabs around the inside [low, high]; walls in the order -x, +x, -y, +y.
void shell(Room& room, const Material& floor, const Material& ceiling, const std::array<Material, 4>& walls) {
  const double t = 0.1;
  const Vec size = room.high - room.low, middle = (room.low + room.high) / 2;
  Place place(room, middle[0], middle[1], 0);
  place.box(0, 0, -t, Vec(size[0] + 2 * t, size[1] + 2 * t, t), floor);
  place.box(0, 0, size[2], Vec(size[0] + 2 * t, size[1] + 2 * t, t), ceiling);
  for (const int side : {-1, 1}) {
    place.box(side * (size[0] + t) / 2, 0, 0, Vec(t, size[1], size[2]), walls[side < 0 ? 0 : 1]);
    place.box(0, side * (size[1] + t) / 2, 0, Vec(size[0], t, size[2]), walls[side < 0 ? 2 : 3]);
    place.box(side * (size[0] / 2 - 0.008), 0, 0, Vec(0.016, size[1], 0.09), kWhite);  // skirting boards
    place.box(0, side * (size[1] / 2 - 0.008), 0, Vec(size[0], 0.016, 0.09), kWhite);
  }
}

void four_legs(Place p, double width, double depth, double height, double thickness, const Material& m) {
  for (const int sx : {-1, 1})
    for (const int sy : {-1, 1})
      p.box(sx * (width - thickness) / 2, sy * (depth - thickness) / 2, 0, Vec(thickness, thickness, height),
            m);
}

void table(Place p, double width, double depth, double height, const Material& m) {
  p.box(0, 0, height - 0.035, Vec(width, depth, 0.035), m);
  p.box(0, 0, height - 0.11, Vec(width - 0.16, depth - 0.16, 0.075), m);
  four_legs(p, width - 0.06, depth - 0.06, height - 0.035, 0.055, m);
}

void chair(Place p, const Material& frame, const Material& seat) {
  four_legs(p, 0.42, 0.42, 0.43, 0.035, frame);
  p.box(0, 0, 0.43, Vec(0.44, 0.44, 0.04), seat);
  for (const int side : {-1, 1}) p.box(side * 0.19, 0.205, 0.47, Vec(0.035, 0.03, 0.45), frame, turn(0, -6));
  for (int k = 0; k < 3; ++k)
    p.box(0, 0.20 + 0.016 * k, 0.57 + 0.12 * k, Vec(0.36, 0.018, 0.07), frame, turn(0, -6));
}

void sofa(Place p, double width, const Material& cloth, const Material& foot) {
  four_legs(p, width - 0.1, 0.75, 0.11, 0.05, foot);
  p.box(0, 0, 0.11, Vec(width, 0.85, 0.17), cloth);
  p.box(0, 0.34, 0.28, Vec(width - 0.34, 0.17, 0.50), cloth, turn(0, -7));
  p.roll(0, 0.37, 0.78, 0.085, width - 0.34, cloth);
  const double seat = (width - 0.36) / 2;
  for (const int side : {-1, 1}) {
    p.box(side * (width - 0.17) / 2, 0, 0.28, Vec(0.17, 0.85, 0.24), cloth);
    p.roll(side * (width - 0.17) / 2, 0, 0.53, 0.09, 0.85, cloth, 90);
    p.box(side * seat / 2, -0.08, 0.28, Vec(seat - 0.01, 0.66, 0.15), cloth);
    p.roll(side * seat / 2, -0.41, 0.355, 0.075, seat - 0.01, cloth);
  }
}

void pillow(Place p, double x, double y, double z, double yaw, const Material& m) {
  p.box(x, y, z, Vec(0.40, 0.12, 0.36), m, turn(yaw, -22));
}

Material spine(uint32_t k) {
  static const Vec colors[] = {Vec(0.66, 0.20, 0.18), Vec(0.17, 0.33, 0.50), Vec(0.87, 0.74, 0.42),
                               Vec(0.24, 0.44, 0.33), Vec(0.90, 0.87, 0.80), Vec(0.45, 0.25, 0.42),
                               Vec(0.88, 0.52, 0.24), Vec(0.25, 0.26, 0.30)};
  const Vec band = k % 2 ? Vec(0.93, 0.88, 0.72) : Vec(0.16, 0.15, 0.17);
  return {Pattern::book, colors[(k * 5 + k / 8) % 8], band, 0.1, k};
}

// A row of books from x, each of its own thickness and height, the last one leaning.
void books(Place p, double x, double y, double z, int count, uint32_t seed) {
  for (int k = 0; k < count; ++k) {
    const uint32_t n = seed * 17 + k * 7;
    const double thickness = 0.022 + 0.004 * (n % 7), height = 0.19 + 0.014 * (n % 6);
    const bool leans = k == count - 1;
    p.box(x + thickness / 2 + (leans ? 0.035 : 0), y - 0.008 * (n % 3), z, Vec(thickness, 0.16, height),
          spine(n), leans ? turn(0, 0, -13) : turn(0));
    x += thickness + 0.002;
  }
}

void vase(Place p, double x, double y, double z, double size, const Material& m) {
  p.sphere(x, y, z + 0.48 * size, 0.5 * size, m);
  p.cylinder(x, y, z, 0.28 * size, 0.10 * size, m);
  p.cylinder(x, y, z + 0.9 * size, 0.2 * size, 0.45 * size, m);
  p.cylinder(x, y, z + 1.3 * size, 0.27 * size, 0.06 * size, m);
}

void mug(Place p, double x, double y, double z, const Material& m) {
  p.cylinder(x, y, z, 0.04, 0.10, m);
  p.box(x + 0.05, y, z + 0.025, Vec(0.035, 0.012, 0.055), m);
}

// Sides, back, boards and what stands on them.
void bookcase(Place p, double width, double height, int boards, const Material& m, uint32_t seed) {
  const double depth = 0.30, gap = (height - 0.025) / boards;
  for (const int side : {-1, 1}) p.box(side * (width - 0.025) / 2, 0, 0, Vec(0.025, depth, height), m);
  p.box(0, depth / 2 - 0.006, 0, Vec(width, 0.012, height), m);
  for (int k = 0; k <= boards; ++k) p.box(0, 0, gap * k, Vec(width - 0.05, depth, 0.025), m);
  for (int k = 0; k < boards; ++k) {
    const double z = gap * k + 0.025, left = -width / 2 + 0.03 + 0.05 * (k % 2);
    books(p, left, 0, z, 7 + (k * 3 + seed) % 4, seed + k);
    const double x = width / 2 - 0.17;
    if (k % 4 == 0) vase(p, x, -0.03, z, 0.15, plain(0.20, 0.45, 0.55));
    if (k % 4 == 1)
      p.box(x, 0.02, z, Vec(0.2, 0.18, 0.14),
            {Pattern::checker, Vec(0.85, 0.80, 0.70), Vec(0.6, 0.35, 0.25), 0.03});
    if (k % 4 == 2)
      p.sphere(x, -0.02, z + 0.08, 0.08,
               {Pattern::plaster, Vec(0.25, 0.45, 0.65), Vec(0.70, 0.72, 0.45), 0.04, 5});
    if (k % 4 == 3)
      p.cylinder(x, -0.02, z, 0.06, 0.16,
                 {Pattern::stripes, Vec(0.88, 0.85, 0.78), Vec(0.75, 0.35, 0.28), 0.05});
  }
}

// Two doors with handles, on a plinth that is set back.
void cupboard(Place p, double width, double depth, double height, const Material& body,
              const Material& door) {
  p.box(0, 0.02, 0, Vec(width - 0.04, depth - 0.08, 0.08), kBlack);
  p.box(0, 0, 0.08, Vec(width, depth, height - 0.08), body);
  for (const int side : {-1, 1}) {
    p.box(side * width / 4, -depth / 2 - 0.009, 0.11, Vec(width / 2 - 0.02, 0.018, height - 0.15), door);
    p.cylinder(side * 0.05, -depth / 2 - 0.03, height * 0.48, 0.008, 0.14, kSteel);
  }
}

void floor_lamp(Place p) {
  p.cylinder(0, 0, 0, 0.15, 0.025, kBlack);
  p.cylinder(0, 0, 0.025, 0.012, 1.5, kBlack);
  p.cylinder(0, 0, 1.42, 0.19, 0.26, glow(0.99, 0.90, 0.70));
  p.cylinder(0, 0, 1.415, 0.193, 0.012, plain(0.75, 0.6, 0.4));
  p.cylinder(0, 0, 1.673, 0.193, 0.012, plain(0.75, 0.6, 0.4));
}

void pendant(Place p, double ceiling, double drop) {
  p.cylinder(0, 0, ceiling - drop, 0.006, drop, kBlack);
  p.cylinder(0, 0, ceiling - 0.03, 0.05, 0.03, kWhite);
  p.sphere(0, 0, ceiling - drop, 0.16, glow(0.99, 0.95, 0.83));
}

void plant(Place p, double size) {
  p.cylinder(0, 0, 0, 0.17 * size, 0.30 * size,
             {Pattern::stripes, Vec(0.78, 0.45, 0.32), Vec(0.70, 0.38, 0.27), 0.09});
  p.cylinder(0, 0, 0.29 * size, 0.185 * size, 0.035 * size, plain(0.80, 0.48, 0.35));
  p.cylinder(0, 0, 0.30 * size, 0.02 * size, 0.5 * size, kWalnut);
  for (int k = 0; k < 16; ++k) {  // leaves along a spiral
    const double a = 2.4 * k, r = (0.10 + 0.011 * k * (16 - k) / 4) * size;
    p.sphere(r * std::cos(a), r * std::sin(a), (0.55 + 0.042 * k) * size, (0.13 - 0.003 * k) * size,
             leaves(k));
  }
}

// On the wall behind (at +y of the frame), its middle at height z.
void picture(Place p, double x, double z, double width, double height, Vec tone, const Material& frame,
             uint32_t seed) {
  p.box(x, -0.015, z - height / 2, Vec(width, 0.03, height), {Pattern::picture, tone, frame.b, 0.1, seed});
}

void window(Place p, double width, double height, double sill) {
  p.box(0, -0.01, sill, Vec(width, 0.02, height),
        {Pattern::window, Vec(0.55, 0.75, 0.95), Vec(0.90, 0.95, 1.0), 0.1, 3, true});
  for (const int side : {-1, 0, 1})
    p.box(side * width / 2, -0.03, sill, Vec(0.06, 0.06, height + 0.03), kWhite);
  for (const double z : {0.0, 0.62 * height, height})
    p.box(0, -0.03, sill + z - 0.03, Vec(width, 0.06, 0.06), kWhite);
  p.box(0, -0.08, sill - 0.06, Vec(width + 0.2, 0.16, 0.03), kWhite);
}

void curtain(Place p, double x, double top, int folds, const Material& m) {
  for (int k = 0; k < folds; ++k)
    p.cylinder(x + 0.075 * k, -0.11 - 0.02 * (k % 2), 0.12, 0.046, top - 0.12, m);
}

void radiator(Place p, double width) {
  for (double x = -width / 2; x <= width / 2; x += 0.08) p.cylinder(x, -0.08, 0.12, 0.03, 0.5, kWhite);
  p.roll(0, -0.08, 0.14, 0.02, width, kWhite);
  p.roll(0, -0.08, 0.60, 0.02, width, kWhite);
}

void door(Place p, const Material& m) {
  p.box(0, -0.02, 0, Vec(0.98, 0.04, 2.09), kWhite);
  p.box(0, -0.035, 0, Vec(0.84, 0.03, 2.02), m);
  for (const double z : {0.15, 1.05}) p.box(0, -0.0465, z, Vec(0.58, 0.012, 0.78), m);
  p.cylinder(0.36, -0.075, 1.0, 0.012, 0.05, kSteel);
  p.roll(0.31, -0.085, 1.03, 0.011, 0.12, kSteel);
}

void parcel(Place p, double x, double y, double z, Vec size, double yaw, uint32_t seed) {
  p.box(x, y, z, size, {Pattern::parcel, Vec(0.76, 0.60, 0.42), Vec(0.66, 0.50, 0.34), 0.05, seed},
        turn(yaw));
}

void wall_clock(Place p, double x, double z) {
  p.box(x, -0.02, z - 0.15, Vec(0.30, 0.04, 0.30), kWalnut);
  p.box(x, -0.042, z - 0.13, Vec(0.26, 0.01, 0.26), kCeramic);
  p.box(x, -0.05, z, Vec(0.012, 0.008, 0.10), kBlack);
  p.box(x + 0.03, -0.05, z - 0.006, Vec(0.08, 0.008, 0.012), kBlack);
}

void fruit_bowl(Place p, double x, double y, double z) {
  p.cylinder(x, y, z, 0.07, 0.02, kCeramic);
  p.cylinder(x, y, z + 0.02, 0.15, 0.035, {Pattern::plain, Vec(0.25, 0.42, 0.55), Vec(0.25, 0.42, 0.55)});
  const Vec colors[] = {Vec(0.86, 0.25, 0.18), Vec(0.95, 0.62, 0.15), Vec(0.62, 0.74, 0.25)};
  for (int k = 0; k < 5; ++k) {
    const double a = 1.2566 * k;
    p.sphere(x + 0.075 * std::cos(a), y + 0.075 * std::sin(a), z + 0.088, 0.04,
             {Pattern::plaster, colors[k % 3], colors[k % 3] * 0.8, 0.02, static_cast<uint32_t>(k)});
  }
  p.sphere(x, y, z + 0.13, 0.04, {Pattern::plaster, colors[1], colors[1] * 0.85, 0.02, 9});
}

void laptop(Place p, double x, double y, double z, double yaw) {
  Place q = p.at(x, y, yaw, z);
  q.box(0, 0, 0, Vec(0.34, 0.24, 0.016), kSteel);
  q.box(0, -0.01, 0.016, Vec(0.29, 0.11, 0.002),
        {Pattern::checker, Vec(0.12, 0.12, 0.13), Vec(0.22, 0.22, 0.24), 0.0095});
  q.box(0, 0.15, 0.01, Vec(0.34, 0.012, 0.23),
        {Pattern::picture, Vec(0.3, 0.5, 0.7), Vec(0.1, 0.1, 0.1), 0.1, 11}, turn(0, -18));
}

void living_room(Room& room) {
  room.low = Vec(-2.5, -2.0, 0);
  room.high = Vec(2.5, 2.0, 2.7);
  room.lamps = {Lamp{Vec(1.35, -0.55, 1.85), Vec(1.5, 1.35, 1.1), 0.35},
                Lamp{Vec(-1.75, 0.15, 1.75), Vec(1.9, 2.0, 2.15), 0.5}};
  const Material paint{Pattern::plaster, Vec(0.90, 0.87, 0.80), Vec(0.82, 0.78, 0.70), 0.16, 1};
  const Material accent{Pattern::wallpaper, Vec(0.38, 0.54, 0.56), Vec(0.50, 0.66, 0.66), 0.22, 2};
  const Material warm{Pattern::plaster, Vec(0.88, 0.78, 0.66), Vec(0.82, 0.70, 0.56), 0.20, 3};
  shell(room, {Pattern::planks, Vec(0.80, 0.62, 0.42), Vec(0.64, 0.45, 0.28), 0.13, 4},
        plain(0.95, 0.94, 0.92), {paint, warm, accent, paint});
  const Place west(room, -2.5, 0, 90), east(room, 2.5, 0, -90), south(room, 0, -2.0, 180),
      north(room, 0, 2.0, 0);

  Place sitting(room, -0.75, -1.42, 180);  // back toward the south wall, 15 cm in front of it
  const Material sofa_cloth = fabric(Vec(0.55, 0.62, 0.68), Vec(0.38, 0.45, 0.52), 1);
  sofa(sitting, 2.0, sofa_cloth, kWalnut);
  pillow(sitting, -0.62, 0.10, 0.44, 12,
         {Pattern::stripes, Vec(0.93, 0.88, 0.76), Vec(0.80, 0.42, 0.28), 0.07});
  pillow(sitting, 0.60, 0.11, 0.44, -14,
         {Pattern::checker, Vec(0.86, 0.68, 0.30), Vec(0.92, 0.84, 0.62), 0.06});
  pillow(sitting, 0.22, 0.12, 0.44, 6, fabric(Vec(0.30, 0.50, 0.50), Vec(0.18, 0.34, 0.36), 7));
  Place(room, -0.75, -0.25, 0)
      .box(0, 0, 0, Vec(2.1, 1.5, 0.012),
           {Pattern::carpet, Vec(0.62, 0.18, 0.17), Vec(0.16, 0.22, 0.36), 0.18, 5});

  Place coffee(room, -0.75, -0.30, 8);
  coffee.box(0, 0, 0.38, Vec(1.05, 0.58, 0.035), kWalnut);
  coffee.box(0, 0, 0.15, Vec(0.92, 0.46, 0.02), kWalnut);
  four_legs(coffee, 1.0, 0.54, 0.38, 0.045, kWalnut);
  fruit_bowl(coffee, -0.25, 0.05, 0.415);
  for (int k = 0; k < 3; ++k)
    coffee.box(0.28 - 0.01 * k, 0.06, 0.415 + 0.03 * k, Vec(0.24 - 0.02 * k, 0.17, 0.03), spine(3 + 4 * k),
               turn(20 - 17 * k));
  mug(coffee, 0.05, -0.17, 0.415, plain(0.85, 0.45, 0.30));
  coffee.box(-0.15, 0, 0.17, Vec(0.3, 0.22, 0.06), spine(9), turn(-9));

  Place dining(room, 1.35, -0.55, 90);
  table(dining, 1.25, 0.78, 0.75, kOak);
  chair(Place(room, 0.78, -0.80, 98), kPine, fabric(Vec(0.78, 0.36, 0.26), Vec(0.62, 0.25, 0.18), 3));
  chair(Place(room, 0.62, -0.12, 62), kPine, fabric(Vec(0.78, 0.36, 0.26), Vec(0.62, 0.25, 0.18), 4));
  chair(Place(room, 2.00, -0.50, -92), kPine, fabric(Vec(0.78, 0.36, 0.26), Vec(0.62, 0.25, 0.18), 5));
  laptop(dining, 0.28, -0.08, 0.75, -12);
  vase(dining, -0.22, 0.12, 0.75, 0.16, plain(0.88, 0.62, 0.30));
  for (int k = 0; k < 5; ++k)
    dining.sphere(-0.22 + 0.06 * std::cos(1.3 * k), 0.12 + 0.06 * std::sin(1.3 * k), 1.00 + 0.025 * k, 0.045,
                  leaves(20 + k));
  dining.cylinder(-0.25, -0.22, 0.75, 0.13, 0.012, kCeramic);
  mug(dining, -0.02, -0.24, 0.75, plain(0.25, 0.45, 0.60));
  pendant(Place(room, 1.35, -0.55, 0), 2.7, 0.75);

  bookcase(north.at(-1.55, -0.19, 0), 1.0, 1.85, 5, kPine, 2);
  Place board = north.at(0.25, -0.25, 0);
  board.box(0, 0, 0.14, Vec(1.5, 0.40, 0.30), kOak);
  four_legs(board, 1.4, 0.34, 0.14, 0.05, kBlack);
  for (const int k : {-1, 0, 1}) board.box(0.48 * k, -0.205, 0.165, Vec(0.46, 0.012, 0.25), kWhite);
  board.box(0, 0.05, 0.44, Vec(0.40, 0.18, 0.02), kBlack);
  board.box(0, 0.08, 0.46, Vec(0.08, 0.03, 0.10), kBlack);
  board.box(0, 0.07, 0.53, Vec(1.08, 0.035, 0.62), plain(0.16, 0.17, 0.20));
  vase(board, -0.64, -0.02, 0.44, 0.14, plain(0.75, 0.38, 0.30));
  books(board, 0.56, 0.02, 0.44, 4, 11);

  cupboard(Place(room, 2.12, 1.20, -90), 1.05, 0.50, 1.85, kWhite,
           plain(0.90, 0.89, 0.86));  // 13 cm off the east wall
  parcel(Place(room, 2.1, 1.15, 0), 0, 0, 1.85, Vec(0.36, 0.45, 0.26), 12, 2);
  floor_lamp(Place(room, -2.15, -1.62, 0));
  plant(Place(room, -2.12, 1.18, 0), 0.95);
  Place corner(room, 2.05, -1.52, 0);
  parcel(corner, 0, 0, 0, Vec(0.52, 0.42, 0.38), 14, 1);
  parcel(corner, 0.03, -0.02, 0.38, Vec(0.36, 0.32, 0.26), -11, 4);
  parcel(corner, -0.52, 0.02, 0, Vec(0.34, 0.34, 0.30), 31, 6);

  const Place glass = west.at(0.15, 0, 0);
  window(glass, 1.25, 1.25, 0.92);
  radiator(glass, 1.0);
  const Material drape = fabric(Vec(0.90, 0.80, 0.62), Vec(0.78, 0.64, 0.44), 12);
  curtain(glass, -0.98, 2.32, 5, drape);
  curtain(glass, 0.68, 2.32, 5, drape);
  glass.roll(0, -0.12, 2.36, 0.016, 2.2, kWalnut);

  picture(south, 0.95, 1.55, 0.95, 0.65, Vec(0.35, 0.45, 0.62), kWalnut, 6);
  picture(south, 0.12, 1.62, 0.42, 0.52, Vec(0.90, 0.86, 0.76), kOak, 5);
  picture(east, 0.72, 1.62, 0.80, 0.60, Vec(0.55, 0.40, 0.35), kWalnut, 9);
  picture(east, -0.12, 1.66, 0.40, 0.50, Vec(0.30, 0.45, 0.40), kOak, 8);
  picture(north, -0.62, 1.72, 0.42, 0.42, Vec(0.85, 0.80, 0.70), kWalnut, 13);
  wall_clock(north, 0.28, 1.78);
  door(south.at(-1.15, 0, 0), {Pattern::plain, Vec(0.86, 0.83, 0.77), Vec(0.8, 0.8, 0.8)});
  door(north.at(1.33, 0, 0), {Pattern::plain, Vec(0.86, 0.83, 0.77), Vec(0.8, 0.8, 0.8)});
}

void study(Room& room) {
  room.low = Vec(-2.2, -2.1, 0);
  room.high = Vec(2.2, 2.1, 2.5);
  room.lamps = {Lamp{Vec(0, 0, 1.9), Vec(1.5, 1.38, 1.15), 0.35},
                Lamp{Vec(-0.35, 1.35, 1.7), Vec(1.8, 1.95, 2.1), 0.5}};
  const Material paint{Pattern::plaster, Vec(0.88, 0.86, 0.84), Vec(0.80, 0.78, 0.77), 0.18, 21};
  const Material accent{Pattern::wallpaper, Vec(0.82, 0.74, 0.62), Vec(0.72, 0.52, 0.42), 0.26, 22};
  const Material blue{Pattern::plaster, Vec(0.55, 0.64, 0.74), Vec(0.47, 0.56, 0.67), 0.22, 23};
  shell(room, {Pattern::planks, Vec(0.55, 0.38, 0.27), Vec(0.38, 0.25, 0.18), 0.10, 24},
        plain(0.95, 0.95, 0.94), {accent, paint, blue, paint});
  const Place west(room, -2.2, 0, 90), east(room, 2.2, 0, -90), south(room, 0, -2.1, 180),
      north(room, 0, 2.1, 0);

  Place bed(room, -1.10, -0.85, 90);  // head at the west wall
  four_legs(bed, 1.3, 1.9, 0.22, 0.07, kOak);
  bed.box(0, 0, 0.18, Vec(1.4, 2.02, 0.12), kOak);
  bed.box(0, 0, 0.30, Vec(1.34, 1.94, 0.18), plain(0.92, 0.91, 0.88));
  bed.box(0, -0.28, 0.34, Vec(1.44, 1.40, 0.17),
          {Pattern::stripes, Vec(0.32, 0.44, 0.60), Vec(0.86, 0.84, 0.78), 0.24});
  bed.box(0, 1.03, 0, Vec(1.5, 0.05, 0.95), kOak);
  for (const int side : {-1, 1})
    pillow(bed, side * 0.35, 0.75, 0.47, side * 5, fabric(Vec(0.95, 0.93, 0.90), Vec(0.84, 0.82, 0.78), 30));
  Place night(room, -1.93, 0.28, 90);
  table(night, 0.42, 0.40, 0.48, kOak);
  night.cylinder(0, 0, 0.48, 0.07, 0.02, kBlack);
  night.cylinder(0, 0, 0.50, 0.012, 0.20, kBlack);
  night.cylinder(0, 0, 0.66, 0.11, 0.16, glow(0.98, 0.88, 0.68));

  Place desk = north.at(1.15, -0.42, 0);
  table(desk, 1.5, 0.72, 0.74, kPine);
  laptop(desk, -0.15, -0.05, 0.74, 180);
  desk.box(0.45, 0.16, 0.74, Vec(0.24, 0.18, 0.02), kBlack);
  desk.cylinder(0.45, 0.18, 0.76, 0.02, 0.14, kBlack);
  desk.box(0.45, 0.15, 0.85, Vec(0.54, 0.03, 0.34),
           {Pattern::picture, Vec(0.25, 0.40, 0.60), Vec(0.08, 0.08, 0.09), 0.1, 16}, turn(-14));
  books(desk, -0.66, 0.18, 0.74, 6, 5);
  mug(desk, 0.18, -0.20, 0.74, plain(0.85, 0.72, 0.30));
  Place stool(room, 0.95, 1.02, 205);  // office chair: five feet, column, seat, back
  for (int k = 0; k < 5; ++k) stool.at(0, 0, 72 * k).box(0, 0.15, 0.05, Vec(0.04, 0.30, 0.03), kBlack);
  stool.cylinder(0, 0, 0.06, 0.03, 0.36, kSteel);
  stool.cylinder(0, 0, 0.42, 0.24, 0.07, fabric(Vec(0.24, 0.40, 0.36), Vec(0.15, 0.28, 0.26), 31));
  stool.box(0, 0.23, 0.45, Vec(0.05, 0.02, 0.25), kBlack);
  stool.box(0, 0.22, 0.62, Vec(0.40, 0.06, 0.42), fabric(Vec(0.24, 0.40, 0.36), Vec(0.15, 0.28, 0.26), 32),
            turn(0, -6));

  cupboard(Place(room, 1.86, -1.18, -90), 1.2, 0.55, 2.0, kOak, kOak);  // 6 cm off the east wall
  bookcase(Place(room, 0.72, -1.90, 180), 0.9, 1.5, 4, kWalnut, 6);
  vase(Place(room, 0.62, -1.90, 0), 0, 0, 1.5, 0.2, plain(0.30, 0.42, 0.55));
  Place(room, 0.55, 0.10, 24)
      .box(0, 0, 0, Vec(1.7, 1.2, 0.012),
           {Pattern::carpet, Vec(0.24, 0.36, 0.34), Vec(0.80, 0.72, 0.55), 0.16, 33});
  Place chest(room, 0.35, -0.22, 68);  // a chest on low feet
  four_legs(chest, 0.7, 0.4, 0.07, 0.05, kBlack);
  chest.box(0, 0, 0.07, Vec(0.74, 0.44, 0.30), kWalnut);
  chest.box(0, 0, 0.37, Vec(0.78, 0.48, 0.035), kWalnut);
  for (int k = 0; k < 3; ++k)
    chest.box(0.12, 0, 0.405 + 0.035 * k, Vec(0.26, 0.20 - 0.01 * k, 0.035), spine(1 + 3 * k),
              turn(15 * k - 10));
  chest.sphere(-0.2, 0.03, 0.525, 0.12,
               {Pattern::checker, Vec(0.92, 0.90, 0.84), Vec(0.78, 0.30, 0.22), 0.07});
  plant(Place(room, 1.82, 0.55, 0), 0.85);
  parcel(Place(room, -1.85, 1.72, 0), 0, 0, 0, Vec(0.45, 0.5, 0.42), -9, 3);
  parcel(Place(room, -1.83, 1.74, 0), 0, 0, 0.42, Vec(0.38, 0.36, 0.22), 17, 8);
  Place shelf = south.at(1.1, -0.13, 0, 1.35);  // a board on the wall, free below
  shelf.box(0, 0, 0, Vec(1.1, 0.24, 0.03), kPine);
  books(shelf, -0.48, 0, 0.03, 8, 9);
  vase(shelf, 0.38, 0, 0.03, 0.13, plain(0.82, 0.45, 0.32));
  pendant(Place(room, 0, 0, 0), 2.5, 0.5);
  const Place glass = north.at(-0.35, 0, 0);
  window(glass, 1.1, 1.15, 0.95);
  radiator(glass, 0.9);
  const Material drape = fabric(Vec(0.60, 0.68, 0.62), Vec(0.45, 0.54, 0.50), 34);
  curtain(glass, -0.90, 2.25, 4, drape);
  picture(west, 0.9, 1.55, 0.9, 0.6, Vec(0.30, 0.42, 0.50), kOak, 4);
  picture(east, -0.25, 1.60, 0.7, 0.5, Vec(0.80, 0.66, 0.45), kWalnut, 7);
  picture(north, 1.25, 1.62, 0.5, 0.62, Vec(0.35, 0.35, 0.55), kOak, 15);
  door(west.at(1.22, 0, 0), {Pattern::plain, Vec(0.80, 0.82, 0.82), Vec(0.8, 0.8, 0.8)});
}

}  // namespace

Room make_room(int number) {
  if (number != 0 && number != 1)
    throw std::invalid_argument("there are two built-in rooms, 0 and 1; got " + std::to_string(number));
  Room room;
  if (number == 0) living_room(room);
  if (number == 1) study(room);
  room.light.build(room);
  return room;
}

}  // namespace snh::builtin
