// Sign of the turn a -> b -> c, exact: a rounded determinant decides where its error bound allows, else the
// exact expansion of Shewchuk, "Adaptive precision floating-point arithmetic and fast robust geometric
// predicates" (1997).
#pragma once

#include <cmath>

namespace snh {

struct Point {
  double u, v;
};

// An exact sum of doubles, kept as terms that do not overlap, the largest last (grow-expansion).
class ExactSum {
 public:
  void add_product(double a, double b) {
    const double product = a * b;
    add(std::fma(a, b, -product));
    add(product);
  }

  int sign() const {
    for (int k = size_ - 1; k >= 0; --k)
      if (terms_[k] != 0) return terms_[k] > 0 ? 1 : -1;
    return 0;
  }

 private:
  void add(double x) {
    for (int k = 0; k < size_; ++k) {  // two-sum: x + term = sum + error, both exact
      const double term = terms_[k], sum = x + term, shift = sum - x;
      terms_[k] = (x - (sum - shift)) + (term - shift);
      x = sum;
    }
    terms_[size_++] = x;
  }

  double terms_[12];
  int size_ = 0;
};

// 1 = counter-clockwise, -1 = clockwise, 0 = on a line.
inline int turn(const Point& a, const Point& b, const Point& c) {
  const double left = (b.u - a.u) * (c.v - a.v), right = (b.v - a.v) * (c.u - a.u), turn = left - right;
  constexpr double kBound = 3.3306690738754716e-16;  // (3 + 16 e) e with e = 2^-53
  if (std::abs(turn) > kBound * (std::abs(left) + std::abs(right)) || left == 0 || right == 0)
    return (turn > 0) - (turn < 0);
  ExactSum sum;
  sum.add_product(b.u, c.v);
  sum.add_product(-b.u, a.v);
  sum.add_product(-a.u, c.v);
  sum.add_product(-b.v, c.u);
  sum.add_product(b.v, a.u);
  sum.add_product(a.v, c.u);
  return sum.sign();
}

}  // namespace snh
