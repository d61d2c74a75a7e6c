#include "hull_cells/hull_cells.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>
#include <stdexcept>
#include <string>

#include "common/key.h"
#include "common/lattice.h"
#include "hull_cells/exact.h"

namespace snh::cpu {

namespace {

using Polygon = std::vector<Point>;  // corners counter-clockwise

std::string text(double number) {
  char buffer[32];
  std::snprintf(buffer, sizeof buffer, "%g", number);
  return buffer;
}

[[noreturn]] void fail(const std::string& sentence) {
  throw std::runtime_error("snh::hull_cells: " + sentence);
}

// Convex hull by Andrew's monotone chain with the exact turn.
Polygon convex_hull(std::vector<Point> points) {
  const auto before = [](const Point& a, const Point& b) { return a.u != b.u ? a.u < b.u : a.v < b.v; };
  const auto same = [](const Point& a, const Point& b) { return a.u == b.u && a.v == b.v; };
  std::sort(points.begin(), points.end(), before);
  points.erase(std::unique(points.begin(), points.end(), same), points.end());
  if (points.size() < 3) return points;

  Polygon hull;
  const auto add = [&hull](const Point& p, size_t first) {  // `first`: corners that stay
    while (hull.size() >= first + 2 && turn(hull[hull.size() - 2], hull.back(), p) <= 0) hull.pop_back();
    hull.push_back(p);
  };
  for (const Point& p : points) add(p, 0);  // lower chain, left to right
  hull.pop_back();                          // its end begins the upper chain
  const size_t lower = hull.size();
  for (auto p = points.rbegin(); p != points.rend(); ++p) add(*p, lower);
  hull.pop_back();  // the first corner again
  return hull;
}

// Whether points lie in a convex polygon. Most points of a frame are decided by a table over u: in each of
// many narrow bins the lower and the upper side are replaced by chords, which by convexity run inside, moved
// inwards by more than the rounding of their evaluation. The exact turn decides the rest: those close to the
// sides, as on a flat wall.
template <typename T>
class Region {
 public:
  explicit Region(const Polygon& hull) {
    const auto right = std::max_element(hull.begin(), hull.end(), [](auto& a, auto& b) { return a.u < b.u; });
    inv_width_ = static_cast<T>(kBins / (right->u - hull[0].u));
    if (!std::isfinite(inv_width_)) return;  // no width: nothing is inside
    low_u_ = static_cast<T>(hull[0].u);
    high_u_ = static_cast<T>(right->u);

    lower_.assign(hull.begin(), right + 1);
    upper_.assign(right, hull.end());
    upper_.push_back(hull[0]);
    if (upper_.size() > 2 && upper_[1].u == upper_[0].u) upper_.erase(upper_.begin());  // vertical right side
    std::reverse(upper_.begin(), upper_.end());
    if (upper_.size() > 2 && upper_[1].u == upper_[0].u) upper_.erase(upper_.begin());  // vertical left side
    for (int bin = 0; bin < kBins; ++bin) bins_.push_back(make_bin(bin));
  }

  // False may be wrong close to a side; true never is. Coordinates that are not finite are never inside.
  bool surely_holds(T u, T v) const {
    if (!(u >= low_u_ && u <= high_u_)) return false;
    const Bin& bin = bins_[std::min(static_cast<int>((u - low_u_) * inv_width_), kBins - 1)];
    const T du = u - bin.u;
    return v >= bin.lower + bin.lower_slope * du && v <= bin.upper + bin.upper_slope * du;
  }

  // Exact; sides and corners belong to the polygon.
  bool holds(const Point& p) const {
    if (!(p.u >= low_u_ && p.u <= high_u_)) return false;
    const Point *low = side_at(lower_, p.u), *high = side_at(upper_, p.u);
    return turn(low[0], low[1], p) >= 0 && turn(high[0], high[1], p) <= 0;
  }

 private:
  static constexpr int kBins = 512;
  struct Bin {
    T u, lower, lower_slope, upper, upper_slope;  // chords: lower + lower_slope * (u' - u)
  };

  // The side (two corners) of a chain, ascending in u, above or below u.
  static const Point* side_at(const Polygon& chain, double u) {
    const auto end =
        std::upper_bound(chain.begin() + 1, chain.end() - 1, u, [](double x, auto& p) { return x < p.u; });
    return &*end - 1;
  }

  static double height(const Polygon& chain, double u) {
    const Point* side = side_at(chain, u);
    return side[0].v + (u - side[0].u) / (side[1].u - side[0].u) * (side[1].v - side[0].v);
  }

  // The chords reach beyond the bin by more than the rounding of the bin's number.
  Bin make_bin(int bin) const {
    const double low = low_u_, high = high_u_, width = (high - low) / kBins;
    const double u0 = std::max(low, low + (bin - 0.01) * width),
                 u1 = std::min(high, low + (bin + 1.01) * width);
    double size = std::max(std::abs(low), std::abs(high));
    for (const Polygon* chain : {&lower_, &upper_})
      for (const Point& p : *chain) size = std::max(size, std::abs(p.v));
    const double margin = 16 * static_cast<double>(std::numeric_limits<T>::epsilon()) * size;
    const double lower = height(lower_, u0), lower_slope = (height(lower_, u1) - lower) / (u1 - u0);
    const double upper = height(upper_, u0), upper_slope = (height(upper_, u1) - upper) / (u1 - u0);
    return {static_cast<T>(u0), static_cast<T>(lower + margin * (1 + std::abs(lower_slope))),
            static_cast<T>(lower_slope), static_cast<T>(upper - margin * (1 + std::abs(upper_slope))),
            static_cast<T>(upper_slope)};
  }

  T low_u_ = 1, high_u_ = 0, inv_width_;  // empty
  Polygon lower_, upper_;                 // sides from left to right
  std::vector<Bin> bins_;
};

template <typename T>
Point on_plane(const T* point, int plane) {
  return {static_cast<double>(point[axis_u(plane)]), static_cast<double>(point[axis_v(plane)])};
}

bool is_finite(const Point& p) { return std::isfinite(p.u) && std::isfinite(p.v); }

template <typename T>
void append_finite(const T* points, int64_t n, int plane, std::vector<Point>& list) {
  list.push_back(on_plane(points + 3 * n, plane));
  if (!is_finite(list.back())) fail("point " + std::to_string(n) + " is not finite");
}

// Points among which all hull corners are. Of many points only those are kept that lie outside the hull of a
// sample; they are few, as the chance of a point to do so is (corners of the hull) / (size of the sample),
// whatever the shape. The sample is spread by a multiplicative hash: a plain stride would take whole columns
// of an image.
template <typename T>
std::vector<Point> hull_candidates(const T* points, int64_t n_points, const T* origin, int plane) {
  constexpr int64_t kSample = 2048;
  std::vector<Point> candidates = {on_plane(origin, plane)};
  if (!is_finite(candidates[0])) fail("argument 'origin' is not finite");
  if (n_points <= 4 * kSample) {
    for (int64_t n = 0; n < n_points; ++n) append_finite(points, n, plane, candidates);
    return candidates;
  }
  for (uint64_t k = 0; k < kSample; ++k)
    append_finite(points, static_cast<int64_t>(k * 0x9E3779B97F4A7C15u % n_points), plane, candidates);
  candidates = convex_hull(candidates);
  const Region<T> sampled(candidates);
  for (int64_t n = 0; n < n_points; ++n) {
    if (sampled.surely_holds(points[3 * n + axis_u(plane)], points[3 * n + axis_v(plane)])) continue;
    append_finite(points, n, plane, candidates);
    if (sampled.holds(candidates.back())) candidates.pop_back();
  }
  return candidates;
}

// Centroid of the area, from the triangles at corner 0. Their areas are never negative but for rounding.
Point centroid(const Polygon& hull) {
  double area = 0;
  Point sum{0, 0};  // of area times centroid relative to corner 0, times 3
  for (size_t k = 2; k < hull.size(); ++k) {
    const Point a{hull[k - 1].u - hull[0].u, hull[k - 1].v - hull[0].v},
        b{hull[k].u - hull[0].u, hull[k].v - hull[0].v};
    const double triangle = std::max(0.0, a.u * b.v - a.v * b.u);
    area += triangle;
    sum.u += triangle * (a.u + b.u);
    sum.v += triangle * (a.v + b.v);
  }
  if (area > 0) return {hull[0].u + sum.u / (3 * area), hull[0].v + sum.v / (3 * area)};
  Point mean{0, 0};
  for (const Point& p : hull) {
    mean.u += p.u / hull.size();
    mean.v += p.v / hull.size();
  }
  return mean;
}

// --- cells ---------------------------------------------------------------------------------------------

constexpr int kFractionBits = 32;  // corners are integers, in units of 2^-32 cells
constexpr int64_t kOneCell = int64_t{1} << kFractionBits;

struct Corner {
  int64_t u, v;
};

int64_t cell_of(int64_t fixed) { return fixed >> kFractionBits; }

// Touched cells of each column of cells (i constant): by convexity all from low to high.
struct Columns {
  int64_t first;
  std::vector<int64_t> low, high;

  void include(int64_t column, int64_t cell) {
    low[column - first] = std::min(low[column - first], cell);
    high[column - first] = std::max(high[column - first], cell);
  }
};

// The cells on both sides of each line u = i that the side a -> b crosses. The column right of the line owns
// the crossing itself. The column left of it only comes close: if the side rises to a crossing that is a
// vertex, the nearest cell is the one below.
void include_side(Corner a, Corner b, Columns& columns) {
  if (a.u > b.u) std::swap(a, b);
  const int64_t du = b.u - a.u, dv = b.v - a.v;
  for (int64_t i = cell_of(a.u) + 1; i <= cell_of(b.u); ++i) {
    const __int128 product = static_cast<__int128>(i * kOneCell - a.u) * dv;
    __int128 step = product / du;
    const bool exact = step * du == product;
    if (!exact && product < 0) --step;  // floor
    const int64_t v = a.v + static_cast<int64_t>(step), cell = cell_of(v);
    columns.include(i, cell);
    const bool vertex = exact && v == cell * kOneCell;
    columns.include(i - 1, vertex && dv > 0 ? cell - 1 : cell);
  }
}

Columns touched_cells(const std::vector<Corner>& corners) {
  const auto by_u = [](const Corner& a, const Corner& b) { return a.u < b.u; };
  const auto [left, right] = std::minmax_element(corners.begin(), corners.end(), by_u);
  const int64_t first = cell_of(left->u), count = cell_of(right->u) - first + 1;
  Columns columns{first, std::vector<int64_t>(count, std::numeric_limits<int64_t>::max()),
                  std::vector<int64_t>(count, std::numeric_limits<int64_t>::min())};
  for (size_t k = 0; k < corners.size(); ++k) {
    columns.include(cell_of(corners[k].u), cell_of(corners[k].v));
    include_side(corners[k], corners[(k + 1) % corners.size()], columns);
  }
  return columns;
}

// Vertices of the cells: column i of vertices belongs to the columns i - 1 and i of cells; their intervals meet.
Columns corner_vertices(const Columns& cells) {
  const size_t count = cells.low.size();
  Columns vertices{cells.first, cells.low, cells.high};
  vertices.low.push_back(cells.low[count - 1]);
  vertices.high.push_back(cells.high[count - 1]);
  for (size_t k = 1; k < count; ++k) {
    vertices.low[k] = std::min(cells.low[k - 1], cells.low[k]);
    vertices.high[k] = std::max(cells.high[k - 1], cells.high[k]);
  }
  for (int64_t& high : vertices.high) ++high;
  return vertices;
}

// Bits of the vertices (i, from .. to) in the mask of brick row brick_j.
uint64_t column_bits(int64_t i, int64_t from, int64_t to, int64_t brick_j) {
  from = std::max(from - brick_j * kBrickSide, int64_t{0});
  to = std::min(to - brick_j * kBrickSide, int64_t{kBrickSide - 1});
  if (from > to) return 0;
  constexpr uint64_t kColumn = 0x0101010101010101u;  // bit 8 j of every row j
  return (kColumn >> (8 * (7 - (to - from)))) << (8 * from) << (i & (kBrickSide - 1));
}

void append_bricks(const Columns& vertices, int level, int plane, Bricks& bricks) {
  const int64_t first = vertices.first, end = first + static_cast<int64_t>(vertices.low.size());
  for (int64_t brick_i = first >> kBrickBits; brick_i * kBrickSide < end; ++brick_i) {
    const int64_t i0 = std::max(brick_i * kBrickSide, first), i1 = std::min((brick_i + 1) * kBrickSide, end);
    const int64_t* low = vertices.low.data() + (i0 - first);
    const int64_t* high = vertices.high.data() + (i0 - first);
    const int64_t j0 = *std::min_element(low, low + (i1 - i0)),
                  j1 = *std::max_element(high, high + (i1 - i0));
    for (int64_t brick_j = j0 >> kBrickBits; brick_j <= j1 >> kBrickBits; ++brick_j) {
      uint64_t mask = 0;
      for (int64_t i = i0; i < i1; ++i) mask |= column_bits(i, low[i - i0], high[i - i0], brick_j);
      bricks.keys.push_back(
          pack_key(level, plane, static_cast<int32_t>(brick_i), static_cast<int32_t>(brick_j)));
      bricks.masks.push_back(static_cast<int64_t>(mask));
    }
  }
}

// Corners in units of 2^-32 cells, rounded down, so that each stays in the cell in which a look-up sees it.
template <typename T>
std::vector<Corner> in_cells(const std::vector<T>& hull, double cell_size) {
  const T inv_cell = static_cast<T>(1.0 / cell_size);
  constexpr double kLimit = (1 << 29) - 2;  // floor_cell() saturates beyond
  const auto fixed = [&](T coordinate) {
    const double cells = static_cast<double>(to_cells(coordinate, inv_cell));
    if (!(std::abs(cells) < kLimit))
      fail("the hull reaches " + text(coordinate) + " m, but keys of cells of " + text(cell_size) +
           " m end at " + text(kLimit * cell_size) + " m");
    return static_cast<int64_t>(std::floor(std::ldexp(cells, kFractionBits)));
  };
  std::vector<Corner> corners;
  for (size_t k = 0; k < hull.size(); k += 2) corners.push_back({fixed(hull[k]), fixed(hull[k + 1])});
  return corners;
}

// A glitch in the depth must not fill the memory.
void check_size(const std::vector<Corner>& corners, double cell_size) {
  constexpr double kMaxBricks = 1 << 24;
  Corner low = corners[0], high = corners[0];
  for (const Corner& c : corners) {
    low = {std::min(low.u, c.u), std::min(low.v, c.v)};
    high = {std::max(high.u, c.u), std::max(high.v, c.v)};
  }
  const double width = std::ldexp(high.u - low.u, -kFractionBits),
               height = std::ldexp(high.v - low.v, -kFractionBits);
  if ((width / kBrickSide + 2) * (height / kBrickSide + 2) > kMaxBricks)
    fail("a hull of " + text(width * cell_size) + " x " + text(height * cell_size) +
         " m is too large for cells of " + text(cell_size) + " m; check the depth scale for outliers");
}

}  // namespace

template <typename T>
std::vector<T> plane_hull(const T* points, int64_t n_points, const T* origin, int plane, double hull_scale) {
  const Polygon hull = convex_hull(hull_candidates(points, n_points, origin, plane));
  const Point centre = centroid(hull);
  std::vector<T> corners;
  for (const Point& p : hull) {  // p + (mu - 1)(p - c) and not c + mu (p - c): mu = 1 changes nothing
    corners.push_back(static_cast<T>(p.u + (hull_scale - 1) * (p.u - centre.u)));
    corners.push_back(static_cast<T>(p.v + (hull_scale - 1) * (p.v - centre.v)));
  }
  return corners;
}

template <typename T>
Bricks hull_cells(const T* points, int64_t n_points, const T* origin, const double* cell_sizes, int n_levels,
                  double hull_scale) {
  std::vector<T> hulls[kPlanes];
  for (int plane = 0; plane < kPlanes; ++plane)
    hulls[plane] = plane_hull(points, n_points, origin, plane, hull_scale);
  Bricks bricks;
  for (int level = 0; level < n_levels; ++level)
    for (int plane = 0; plane < kPlanes; ++plane) {
      const std::vector<Corner> corners = in_cells(hulls[plane], cell_sizes[level]);
      check_size(corners, cell_sizes[level]);
      append_bricks(corner_vertices(touched_cells(corners)), level, plane, bricks);
    }
  return bricks;
}

template std::vector<float> plane_hull(const float*, int64_t, const float*, int, double);
template std::vector<double> plane_hull(const double*, int64_t, const double*, int, double);
template Bricks hull_cells(const float*, int64_t, const float*, const double*, int, double);
template Bricks hull_cells(const double*, int64_t, const double*, const double*, int, double);

}  // namespace snh::cpu
