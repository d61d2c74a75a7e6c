// Procedural textures. Each is averaged over the pixel's width on the surface, so that nothing flickers when the
// camera moves: square waves are integrated in closed form, noise fades out where it is finer than the pixels.
#include <algorithm>
#include <array>
#include <cmath>

#include "builtin_scene/builtin_scene.h"

namespace snh::builtin {
namespace {

uint32_t mix_bits(uint32_t x) {
  x = (x ^ (x >> 16)) * 0x7feb352du;
  x = (x ^ (x >> 15)) * 0x846ca68bu;
  return x ^ (x >> 16);
}

// Uniform values on a lattice of 256 x 256 points, repeated; a look-up is several times faster than a hash.
struct Lattice {
  std::array<float, 65536> value;
  Lattice() {
    for (uint32_t k = 0; k < value.size(); ++k)
      value[k] = static_cast<float>(mix_bits(k + 1) * (1.0 / 4294967296.0));
  }
};
const Lattice kLattice;

// Uniform in [0, 1) for a lattice point; seeds shift the lattice.
double random_at(int i, int j, uint32_t seed) {
  const uint32_t column = static_cast<uint32_t>(i) + seed * 101u, row = static_cast<uint32_t>(j) + seed * 37u;
  return kLattice.value[(row & 255) << 8 | (column & 255)];
}

double smooth(double x) { return x * x * (3 - 2 * x); }
// std::floor is a call where the compiler may not assume SSE4.
int floor_of(double x) {
  const int i = static_cast<int>(x);
  return i - (x < i);
}
double radius_of(double x, double y) {
  return std::sqrt(x * x + y * y);
}  // std::hypot guards overflow, slowly
double ramp(double x) { return std::clamp(x, 0.0, 1.0); }

// Value noise in [0, 1], lattice spacing 1.
double noise(double x, double y, uint32_t seed) {
  const int i = floor_of(x), j = floor_of(y);
  const double a = smooth(x - i), b = smooth(y - j);
  const double top = random_at(i, j, seed) * (1 - a) + random_at(i + 1, j, seed) * a;
  const double bottom = random_at(i, j + 1, seed) * (1 - a) + random_at(i + 1, j + 1, seed) * a;
  return top * (1 - b) + bottom * b;
}

// Noise that is 0.5 where its lattice (spacing 1) is finer than two pixels of `width`.
double soft_noise(double x, double y, double width, uint32_t seed) {
  const double contrast = ramp(2 - 4 * width);
  return contrast > 0 ? 0.5 + contrast * (noise(x, y, seed) - 0.5) : 0.5;
}

// Three octaves in [0, 1].
double cloud(double x, double y, double width, uint32_t seed) {
  return 0.5 * soft_noise(x, y, width, seed) + 0.3 * soft_noise(2.7 * x, 2.7 * y, 2.7 * width, seed + 1) +
         0.2 * soft_noise(7.3 * x, 7.3 * y, 7.3 * width, seed + 2);
}

// Mean over `width` of the wave that is 1 on [0, duty) of each period 1.
double wave(double x, double duty, double width) {
  const auto integral = [duty](double t) { return floor_of(t) * duty + std::min(t - floor_of(t), duty); };
  width = std::max(width, 1e-4);
  return (integral(x + width / 2) - integral(x - width / 2)) / width;
}

// 1 inside (distance < 0), 0 outside, the edge as wide as the pixel.
double inside(double distance, double width) { return ramp(0.5 - distance / std::max(width, 1e-4)); }

Vec blend(const Vec& a, const Vec& b, double t) { return a + (b - a) * t; }

Vec plaster(const Material& m, double u, double v, double width) {
  return blend(m.a, m.b, cloud(u / m.scale, v / m.scale, width / m.scale, m.seed));
}

// Grain runs along u: noise stretched 12 times, and streaks.
Vec wood(const Material& m, double u, double v, double width, uint32_t seed) {
  const double s = m.scale;
  const double figure = soft_noise(u / (6 * s), v / (0.5 * s), width / (0.5 * s), seed);
  const double streak = soft_noise(u / (4 * s) + 3 * figure, v / (0.12 * s), width / (0.12 * s), seed + 1);
  return blend(m.a, m.b, 0.6 * figure + 0.4 * streak);
}

// Floor boards of width `scale` and 9 times that length, each with its own tone, dark joints between them.
Vec planks(const Material& m, double u, double v, double width) {
  const double row = v / m.scale, length = 9 * m.scale;
  const int j = floor_of(row);
  const double along = u / length + random_at(j, 7, m.seed);
  const int i = floor_of(along);
  const double tone = 0.86 + 0.28 * random_at(i, j, m.seed + 1);
  const Vec board = wood(m, u, v, width, m.seed + static_cast<uint32_t>(i * 31 + j)) * tone;
  const double joint =
      std::max(wave(row + 0.015, 0.03, width / m.scale), wave(along + 0.002, 0.004, width / length));
  return board * (1 - 0.6 * joint);
}

Vec checker(const Material& m, double u, double v, double width) {
  const double w = width / (2 * m.scale);
  const double x = 2 * wave(u / (2 * m.scale), 0.5, w) - 1, y = 2 * wave(v / (2 * m.scale), 0.5, w) - 1;
  return blend(m.a, m.b, 0.5 - 0.5 * x * y);
}

// Weave: two fine noises, and a coarse one as of wear.
Vec fabric(const Material& m, double u, double v, double width) {
  const double s = m.scale;
  const double thread = soft_noise(u / s, v / (0.25 * s), width / (0.25 * s), m.seed) +
                        soft_noise(u / (0.25 * s), v / s, width / (0.25 * s), m.seed + 1);
  const double wear = soft_noise(u / (9 * s), v / (9 * s), width / (9 * s), m.seed + 2);
  return blend(m.a, m.b, 0.35 * thread + 0.3 * wear);
}

// Border bands, a lattice of diamonds and a medallion in the middle.
Vec carpet(const Material& m, const Surface& s, double width) {
  const double margin = std::min(s.half_u - std::abs(s.u), s.half_v - std::abs(s.v));
  const double cell = m.scale;
  const double du = std::abs(s.u / cell - std::round(s.u / cell)),
               dv = std::abs(s.v / cell - std::round(s.v / cell));
  const Vec accent(0.85, 0.66, 0.38);
  Vec color = blend(m.a, m.b, inside((du + dv - 0.34) * cell, width));
  color = blend(color, accent, inside((du + dv - 0.14) * cell, width));
  const double ring = radius_of(s.u / s.half_u, s.v / s.half_v) * std::min(s.half_u, s.half_v);
  color = blend(color, m.b, inside(ring - 0.5 * s.half_v, width));
  color = blend(color, accent, inside(std::abs(ring - 0.46 * s.half_v) - 0.015, width));
  color = blend(color, m.a, inside(ring - 0.3 * s.half_v, width));
  color = blend(color, m.b, inside(margin - 0.16, width));
  color = blend(color, accent, inside(std::abs(margin - 0.11) - 0.02, width));
  color = blend(color, m.a, inside(margin - 0.03, width));
  const double pile = soft_noise(s.u / 0.02, s.v / 0.02, width / 0.02, m.seed) - 0.5;
  return color * (1 + 0.25 * pile);
}

// Staggered blossoms on a ground that is slightly uneven.
Vec wallpaper(const Material& m, double u, double v, double width) {
  const int row = floor_of(v / m.scale);
  const double x = u / m.scale + 0.5 * (row & 1);
  const double dx = x - floor_of(x) - 0.5, dy = v / m.scale - row - 0.5;
  const double radius = radius_of(dx, dy), c = dx * dx / std::max(radius * radius, 1e-9);
  const double petals = 0.22 + 0.10 * (((32 * c - 48) * c + 18) * c - 1);  // + 0.10 cos(6 angle)
  const double uneven = cloud(u / 0.3, v / 0.3, width / 0.3, m.seed) - 0.5;
  Vec color = blend(m.a, m.b, inside((radius - petals) * m.scale, width));
  color = blend(color, m.a, inside((radius - 0.07) * m.scale, width));
  return color * (1 + 0.12 * uneven);
}

// Colour of a hue in [0, 1), from a circle of 64.
Vec hue(double h) {
  static const std::array<Vec, 64> circle = [] {
    std::array<Vec, 64> made;
    for (int k = 0; k < 64; ++k)
      for (int c = 0; c < 3; ++c) made[k][c] = 0.56 + 0.26 * std::cos(2 * M_PI * (k / 64.0 + c / 3.0));
    return made;
  }();
  return circle[static_cast<int>(h * 64) & 63];
}

// Hills under a sky, or discs over a ground of blocks; b is the frame.
Vec picture(const Material& m, const Surface& s, double width) {
  const double margin = std::min(s.half_u - std::abs(s.u), s.half_v - std::abs(s.v));
  const double frame = 0.13 * std::min(s.half_u, s.half_v);
  const double x = s.u / s.half_v, y = s.v / s.half_v, w = width / s.half_v;
  Vec color;
  if (m.seed % 2 == 0) {
    color = blend(Vec(0.95, 0.80, 0.62), Vec(0.45, 0.64, 0.86), ramp(0.6 * y + 0.4));
    color = blend(color, Vec(0.98, 0.93, 0.70), inside(radius_of(x - 0.35, y - 0.35) - 0.16, w));
    for (int k = 0; k < 4; ++k) {
      const double ridge = 0.15 - 0.28 * k + 0.45 * (noise(x * (1.2 + 0.5 * k), 0.5, m.seed + k) - 0.5);
      color = blend(color, blend(hue(0.45 - 0.07 * k), m.a, 0.45) * (0.95 - 0.16 * k), inside(y - ridge, w));
    }
  } else {
    const int i = floor_of(2.5 * x), j = floor_of(2.5 * y);
    color = blend(m.a, hue(random_at(i, j, m.seed)), 0.45);
    for (int k = 0; k < 6; ++k) {
      const double px = 1.6 * random_at(k, 1, m.seed) - 0.8, py = 1.6 * random_at(k, 2, m.seed) - 0.8;
      const double radius = 0.12 + 0.28 * random_at(k, 3, m.seed);
      color = blend(color, hue(random_at(k, 4, m.seed)), inside(radius_of(x - px, y - py) - radius, w));
    }
  }
  color *= 0.92 + 0.16 * cloud(s.u / 0.04, s.v / 0.04, width / 0.04, m.seed);
  color = blend(color, Vec(0.93, 0.91, 0.86), inside(margin - 1.9 * frame, width));
  return blend(color, m.b, inside(margin - frame, width));
}

// Sky, clouds and trees behind the panes.
Vec window(const Material& m, const Surface& s, double width) {
  const double y = s.v / s.half_v;
  const double clouds = ramp(1.7 * cloud(s.u / 0.5, s.v / 0.25, width / 0.25, m.seed) - 0.5);
  Vec color = blend(blend(m.a, m.b, ramp(0.6 - 0.6 * y)), Vec(1, 1, 1), 0.6 * clouds);
  const double trees =
      -0.45 + 0.5 * (noise(s.u / 0.22, 0.3, m.seed) - 0.5) + 0.2 * (noise(s.u / 0.07, 0.7, m.seed) - 0.5);
  const Vec leaves = blend(Vec(0.42, 0.55, 0.34), Vec(0.60, 0.70, 0.45),
                           cloud(s.u / 0.09, s.v / 0.09, width / 0.09, m.seed));
  return blend(color, leaves, inside((y - trees) * s.half_v, width));
}

// Bands across the spine at both ends.
Vec book(const Material& m, const Surface& s, double width) {
  const double end = std::abs(std::abs(s.v) / s.half_v - 0.72);
  const double label = inside((std::abs(s.v / s.half_v - 0.2) - 0.22) * s.half_v, width);
  Vec color = blend(m.a, m.b, inside((end - 0.05) * s.half_v, width));
  if (m.seed % 3 == 0) color = blend(color, m.b, label);
  return color * (0.94 + 0.12 * soft_noise(s.u / 0.02, s.v / 0.02, width / 0.02, m.seed));
}

// Cardboard with tape along u and a printed mark.
Vec parcel(const Material& m, const Surface& s, double width) {
  Vec color = plaster(m, s.u, s.v, width) * (0.96 + 0.08 * wave(s.u / 0.012, 0.5, width / 0.012));
  color = blend(color, Vec(0.80, 0.70, 0.50), inside(std::abs(s.v) - 0.025, width));
  const double mark =
      std::max(std::abs(s.u - 0.55 * s.half_u) - 0.05, std::abs(s.v + 0.55 * s.half_v) - 0.035);
  color = blend(color, Vec(0.93, 0.92, 0.88), inside(mark, width));
  const double print = wave(s.u / 0.016 + m.seed * 0.3, 0.45, width / 0.016) * inside(mark + 0.012, width);
  return blend(color, Vec(0.15, 0.15, 0.17), print);
}

}  // namespace

Vec reflectance(const Material& m, const Surface& s, double width) {
  switch (m.pattern) {
    case Pattern::plain:
      return m.a;
    case Pattern::plaster:
      return plaster(m, s.u, s.v, width);
    case Pattern::wood: {
      const bool upright = s.half_v > s.half_u;
      return upright ? wood(m, s.v, s.u, width, m.seed) : wood(m, s.u, s.v, width, m.seed);
    }
    case Pattern::planks:
      return planks(m, s.u, s.v, width);
    case Pattern::checker:
      return checker(m, s.u, s.v, width);
    case Pattern::stripes:
      return blend(m.a, m.b, wave(s.u / m.scale, 0.5, width / m.scale));
    case Pattern::carpet:
      return carpet(m, s, width);
    case Pattern::fabric:
      return fabric(m, s.u, s.v, width);
    case Pattern::wallpaper:
      return wallpaper(m, s.u, s.v, width);
    case Pattern::picture:
      return picture(m, s, width);
    case Pattern::window:
      return window(m, s, width);
    case Pattern::book:
      return book(m, s, width);
    case Pattern::parcel:
      return parcel(m, s, width);
  }
  return m.a;
}

}  // namespace snh::builtin
