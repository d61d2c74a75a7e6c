#include "plane_lookup/plane_lookup.h"

#include <Eigen/Core>
#include <type_traits>

#include "common/lattice.h"

namespace snh::cpu {
namespace {

using Eigen::Dynamic;
template <typename T>
using Corners = Eigen::Matrix<T, kCorners, 1>;  // a number per corner
// F: number of features where the compiler knows it, else Dynamic.
template <typename T, int F>
using Rows = Eigen::Matrix<T, F, kCorners>;  // a feature per corner
template <typename T, int F>
using Planes = Eigen::Array<T, F, kPlanes>;  // a feature per plane
template <typename T, int F>
using Feature = Eigen::Map<Eigen::Array<T, F, 1>>;
template <typename T, int F>
using ConstFeature = Eigen::Map<const Eigen::Array<T, F, 1>>;

// Where a point lies on one plane and level: the corners' slots, bilinear weights b, and the weights' derivatives to
// u and v, 1/m. A corner without a vertex has weight zero.
template <typename T>
struct Cell {
  int64_t slot[kCorners];
  Corners<T> b, b_u, b_v, b_uv;

  bool complete() const { return slot[0] >= 0 && slot[1] >= 0 && slot[2] >= 0 && slot[3] >= 0; }
};

template <typename T>
Cell<T> locate(const T* point, int level, int plane, T inv_cell, const TableView& table) {
  const T u = to_cells(point[axis_u(plane)], inv_cell), v = to_cells(point[axis_v(plane)], inv_cell);
  const int32_t i = floor_cell(u), j = floor_cell(v);
  const T p = u - T(i), q = v - T(j);
  Cell<T> cell;
  corner_slots(level, plane, i, j, table, cell.slot);
  cell.b = Corners<T>((1 - p) * (1 - q), p * (1 - q), (1 - p) * q, p * q);
  cell.b_u = Corners<T>(q - 1, 1 - q, -q, q) * inv_cell;
  cell.b_v = Corners<T>(p - 1, -p, 1 - p, p) * inv_cell;
  cell.b_uv = Corners<T>(1, -1, -1, 1) * (inv_cell * inv_cell);
  for (int c = 0; c < kCorners; ++c)
    if (cell.slot[c] < 0) cell.b[c] = cell.b_u[c] = cell.b_v[c] = cell.b_uv[c] = 0;
  return cell;
}

template <typename T, int F>
void gather(const T* rows, int64_t stride, const int64_t* slot, Rows<T, F>& gathered) {
  for (int c = 0; c < kCorners; ++c) {
    if (slot[c] < 0)
      gathered.col(c).setZero();
    else
      gathered.col(c) = ConstFeature<T, F>(rows + slot[c] * stride, gathered.rows()).matrix();
  }
}

// One point seen on the three planes of one level.
template <typename T, int F>
struct View {
  explicit View(const PlaneLookup<T>& in) : in(in), phi(in.n_features, kPlanes) {
    for (Rows<T, F>& r : rows) r.resize(in.n_features, kCorners);
  }
  void look(int64_t n, int level) {
    for (int plane = 0; plane < kPlanes; ++plane) {
      cell[plane] = locate(in.points + n * 3, level, plane, in.inv_cells[level], in.table);
      gather(in.features, in.stride, cell[plane].slot, rows[plane]);
      phi.col(plane) = (rows[plane] * cell[plane].b).array();
    }
  }

  const PlaneLookup<T>& in;
  Cell<T> cell[kPlanes];
  Rows<T, F> rows[kPlanes];
  Planes<T, F> phi;
};

// Eq. 4 on one level: e(phi).
template <typename T, int F>
void reduce_planes(const Planes<T, F>& phi, Reduce reduce, T* encoded) {
  if (reduce == Reduce::kCat)
    Eigen::Map<Planes<T, F>>(encoded, phi.rows(), kPlanes) = phi;
  else if (reduce == Reduce::kSum)
    Feature<T, F>(encoded, phi.rows()) = phi.rowwise().sum();
  else
    Feature<T, F>(encoded, phi.rows()) = phi.rowwise().prod();
}

// dL/dphi from grad = dL/de.
template <typename T, int F>
void reduce_backward(const Planes<T, F>& phi, Reduce reduce, const T* grad, Planes<T, F>& alpha) {
  if (reduce == Reduce::kCat) {
    alpha = Eigen::Map<const Planes<T, F>>(grad, phi.rows(), kPlanes);
    return;
  }
  alpha.colwise() = ConstFeature<T, F>(grad, phi.rows());
  if (reduce == Reduce::kProd)
    for (int p = 0; p < kPlanes; ++p) alpha.col(p) *= phi.col((p + 1) % 3) * phi.col((p + 2) % 3);
}

template <typename T>
int64_t row_begin(const PlaneLookup<T>& in, int64_t n, int level) {
  return n * in.width() + level * in.level_width();
}

// Points in parallel, levels in order: body may write what belongs to point n.
template <typename Visitor, typename Body>
void by_points(const Visitor& prototype, const ParallelFor& parallel, const Body& body) {
  parallel(prototype.in.n_points, [&](int64_t begin, int64_t end) {
    Visitor at = prototype;
    for (int64_t n = begin; n < end; ++n)
      for (int level = 0; level < at.in.n_levels; ++level) {
        at.look(n, level);
        body(at, n, level);
      }
  });
}

// Levels in parallel, points in order: body may write the rows of the table, each of which belongs to one level.
template <typename Visitor, typename Body>
void by_levels(const Visitor& prototype, const ParallelFor& parallel, const Body& body) {
  parallel(prototype.in.n_levels, [&](int64_t begin, int64_t end) {
    Visitor at = prototype;
    for (int64_t level = begin; level < end; ++level)
      for (int64_t n = 0; n < at.in.n_points; ++n) {
        at.look(n, static_cast<int>(level));
        body(at);
      }
  });
}

// The first derivatives of one point on one level:
//   phi = sum_c b_c f_c    =>    dL/du = alpha . sum_c b_u,c f_c,    dL/df_c = b_c alpha    with alpha = dL/dphi.
template <typename T, int F>
struct FirstOrder : View<T, F> {
  FirstOrder(const PlaneLookup<T>& in, const T* grad_encoded)
      : View<T, F>(in), grad_encoded(grad_encoded), alpha(in.n_features, kPlanes) {}

  void look(int64_t n, int level) {
    View<T, F>::look(n, level);
    reduce_backward(this->phi, this->in.reduce, grad_encoded + row_begin(this->in, n, level), alpha);
  }
  void add_to_point(T* grad_point) const {
    for (int plane = 0; plane < kPlanes; ++plane) {
      const auto a = alpha.col(plane).matrix();
      grad_point[axis_u(plane)] += a.dot(this->rows[plane] * this->cell[plane].b_u);
      grad_point[axis_v(plane)] += a.dot(this->rows[plane] * this->cell[plane].b_v);
    }
  }
  void add_to_features(T* grad_features) const {
    for (int plane = 0; plane < kPlanes; ++plane) {
      const Cell<T>& cell = this->cell[plane];
      for (int c = 0; c < kCorners; ++c)
        if (cell.slot[c] >= 0)
          Feature<T, F>(grad_features + cell.slot[c] * this->in.stride, this->in.n_features) +=
              cell.b[c] * alpha.col(plane);
    }
  }

  const T* grad_encoded;
  Planes<T, F> alpha;
};

// The second derivatives of one point on one level. The backward's outputs, contracted with v_x and v_f, are the
// derivative of grad . e along the direction (v_x, v_f); a dot marks derivatives along it:
//   Phi = grad . e_dot,   phi_dot = sum_c b_dot_c f_c + b_c f_dot_c,   b_dot = b_u u_dot + b_v v_dot,   f_dot = v_f.
// With alpha = dPhi/dphi_dot = de/dphi . grad (as in the first order) and beta = dPhi/dphi (zero unless kProd):
//   dPhi/dgrad = e_dot
//   dPhi/du    = alpha . sum_c (b_uv,c v_dot f_c + b_u,c f_dot_c) + beta . sum_c b_u,c f_c     (b_uu = 0)
//   dPhi/df_c  = b_dot_c alpha + b_c beta
template <typename T, int F>
struct SecondOrder : FirstOrder<T, F> {
  SecondOrder(const PlaneLookup<T>& in, const T* grad_encoded, const T* v_points, const T* v_features)
      : FirstOrder<T, F>(in, grad_encoded),
        v_points(v_points),
        v_features(v_features),
        phi_dot(in.n_features, kPlanes),
        beta(Planes<T, F>::Zero(in.n_features, kPlanes)) {
    for (Rows<T, F>& r : rows_dot) r.setZero(in.n_features, kCorners);
  }

  void look(int64_t n, int level) {
    FirstOrder<T, F>::look(n, level);
    for (int plane = 0; plane < kPlanes; ++plane) {
      const Cell<T>& cell = this->cell[plane];
      u_dot[plane] = v_points ? v_points[n * 3 + axis_u(plane)] : T(0);
      v_dot[plane] = v_points ? v_points[n * 3 + axis_v(plane)] : T(0);
      b_dot[plane] = cell.b_u * u_dot[plane] + cell.b_v * v_dot[plane];
      if (v_features) gather(v_features, this->in.stride, cell.slot, rows_dot[plane]);
      phi_dot.col(plane) = (this->rows[plane] * b_dot[plane] + rows_dot[plane] * cell.b).array();
    }
    if (this->in.reduce == Reduce::kProd) product_beta(this->grad_encoded + row_begin(this->in, n, level));
  }
  void write_encoded(T* e_dot) const {
    if (this->in.reduce != Reduce::kProd) return reduce_planes(phi_dot, this->in.reduce, e_dot);
    const Planes<T, F>& phi = this->phi;
    Feature<T, F>(e_dot, phi.rows()) = phi_dot.col(0) * phi.col(1) * phi.col(2) +
                                       phi_dot.col(1) * phi.col(2) * phi.col(0) +
                                       phi_dot.col(2) * phi.col(0) * phi.col(1);
  }
  void add_to_point(T* grad_point) const {
    for (int plane = 0; plane < kPlanes; ++plane) {
      const Cell<T>& cell = this->cell[plane];
      const Rows<T, F>&f = this->rows[plane], &f_dot = rows_dot[plane];
      const auto a = this->alpha.col(plane).matrix(), b = beta.col(plane).matrix();
      grad_point[axis_u(plane)] +=
          a.dot(f * (cell.b_uv * v_dot[plane]) + f_dot * cell.b_u) + b.dot(f * cell.b_u);
      grad_point[axis_v(plane)] +=
          a.dot(f * (cell.b_uv * u_dot[plane]) + f_dot * cell.b_v) + b.dot(f * cell.b_v);
    }
  }
  void add_to_features(T* grad_features) const {
    for (int plane = 0; plane < kPlanes; ++plane) {
      const Cell<T>& cell = this->cell[plane];
      for (int c = 0; c < kCorners; ++c)
        if (cell.slot[c] >= 0)
          Feature<T, F>(grad_features + cell.slot[c] * this->in.stride, this->in.n_features) +=
              b_dot[plane][c] * this->alpha.col(plane) + cell.b[c] * beta.col(plane);
    }
  }

 private:
  // e = phi_0 phi_1 phi_2, so dPhi/dphi_p = grad (phi_dot_q phi_r + phi_q phi_dot_r) with q, r the other planes.
  void product_beta(const T* grad) {
    const Planes<T, F>& phi = this->phi;
    beta.colwise() = ConstFeature<T, F>(grad, phi.rows());
    for (int p = 0; p < kPlanes; ++p) {
      const int q = (p + 1) % 3, r = (p + 2) % 3;
      beta.col(p) *= phi_dot.col(q) * phi.col(r) + phi.col(q) * phi_dot.col(r);
    }
  }

  const T *v_points, *v_features;
  T u_dot[kPlanes], v_dot[kPlanes];
  Corners<T> b_dot[kPlanes];
  Rows<T, F> rows_dot[kPlanes];
  Planes<T, F> phi_dot, beta;
};

// Calls body(F) with F = 3, the paper's and the default, known to the compiler: twice as fast as Dynamic.
template <typename T, typename Body>
void with_features(const PlaneLookup<T>& in, const Body& body) {
  in.n_features == 3 ? body(std::integral_constant<int, 3>()) : body(std::integral_constant<int, Dynamic>());
}

}  // namespace

template <typename T>
void plane_lookup(const PlaneLookup<T>& in, const ParallelFor& over_points, T* encoded, bool* valid) {
  with_features(in, [&](auto n_features) {
    by_points(View<T, n_features>(in), over_points, [&](const auto& at, int64_t n, int level) {
      reduce_planes(at.phi, in.reduce, encoded + row_begin(in, n, level));
      for (int plane = 0; plane < kPlanes; ++plane)
        valid[(n * in.n_levels + level) * kPlanes + plane] = at.cell[plane].complete();
    });
  });
}

template <typename T>
void plane_lookup_backward(const PlaneLookup<T>& in, const T* grad_encoded, const ParallelFor& over_points,
                           const ParallelFor& over_levels, T* grad_points, T* grad_features) {
  with_features(in, [&](auto n_features) {
    const FirstOrder<T, n_features> first(in, grad_encoded);
    if (grad_points)
      by_points(first, over_points,
                [&](const auto& at, int64_t n, int) { at.add_to_point(grad_points + n * 3); });
    if (grad_features)
      by_levels(first, over_levels, [&](const auto& at) { at.add_to_features(grad_features); });
  });
}

template <typename T>
void plane_lookup_double_backward(const PlaneLookup<T>& in, const T* grad_encoded, const T* v_points,
                                  const T* v_features, const ParallelFor& over_points,
                                  const ParallelFor& over_levels, T* grad_grad_encoded, T* grad_points,
                                  T* grad_features) {
  with_features(in, [&](auto n_features) {
    const SecondOrder<T, n_features> second(in, grad_encoded, v_points, v_features);
    by_points(second, over_points, [&](const auto& at, int64_t n, int level) {
      at.write_encoded(grad_grad_encoded + row_begin(in, n, level));
      at.add_to_point(grad_points + n * 3);
    });
    if (grad_features)
      by_levels(second, over_levels, [&](const auto& at) { at.add_to_features(grad_features); });
  });
}

#define SNH_INSTANTIATE(T)                                                                        \
  template void plane_lookup(const PlaneLookup<T>&, const ParallelFor&, T*, bool*);               \
  template void plane_lookup_backward(const PlaneLookup<T>&, const T*, const ParallelFor&,        \
                                      const ParallelFor&, T*, T*);                                \
  template void plane_lookup_double_backward(const PlaneLookup<T>&, const T*, const T*, const T*, \
                                             const ParallelFor&, const ParallelFor&, T*, T*, T*);
SNH_INSTANTIATE(float)
SNH_INSTANTIATE(double)
#undef SNH_INSTANTIATE

}  // namespace snh::cpu
