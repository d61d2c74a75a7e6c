// A block looks up 32 neighbouring points: a warp takes a level (and the eighth after it), a lane a point. Features go
// four columns at a time, 16 bytes where the rows allow it. Formulas and their derivation stand in plane_lookup_cpu.cpp.
#include <cstdint>

#include "common/lookup.cuh"
#include "plane_lookup/plane_lookup.h"

namespace snh::cuda {
namespace {

constexpr int kLevels = 8;  // at a time
constexpr int kThreads = kWarp * kLevels;

// What a kernel gets: the call, with the cell sizes by value.
struct Call {
  PlaneLookup<float> in;
  float inv_cells[kMaxLevels];
  bool vector;  // rows may be read 16 bytes at a time
};

Call make_call(const PlaneLookup<float>& in, const float* other_rows) {
  Call call{in, {}, false};
  for (int level = 0; level < in.n_levels; ++level) call.inv_cells[level] = in.inv_cells[level];
  const auto aligned = [](const float* rows) { return reinterpret_cast<uintptr_t>(rows) % 16 == 0; };
  call.vector = in.stride % 4 == 0 && aligned(in.features) && aligned(other_rows);
  return call;
}

dim3 block_of(const Call& call) {
  return dim3(kWarp, call.in.n_levels < kLevels ? call.in.n_levels : kLevels);
}
unsigned grid_of(const Call& call) { return blocks_for(call.in.n_points, kWarp); }

// One point on the three planes of one level; four columns at a time.
struct View {
  const PlaneLookup<float>& in;
  int level;
  bool vector;
  int64_t n;    // point
  bool active;  // lanes beyond the last point take part in warp operations only
  Cell cell[kPlanes];

  __device__ View(const Call& call, int level)
      : in(call.in),
        level(level),
        vector(call.vector),
        n(static_cast<int64_t>(blockIdx.x) * kWarp + threadIdx.x),
        active(n < call.in.n_points) {
    if (!active) {
#pragma unroll
      for (int plane = 0; plane < kPlanes; ++plane) cell[plane] = Cell::nowhere();
      return;
    }
    const float point[3] = {in.points[3 * n], in.points[3 * n + 1], in.points[3 * n + 2]};
#pragma unroll
    for (int plane = 0; plane < kPlanes; ++plane)
      cell[plane] = Cell(point, level, plane, call.inv_cells[level], in.table);
  }

  __device__ Columns columns(int first) const {
    return {first, in.n_features - first < 4 ? in.n_features - first : 4, vector, in.stride};
  }
  __device__ void phi(const Columns& columns, float4 result[kPlanes]) const {
#pragma unroll
    for (int plane = 0; plane < kPlanes; ++plane) {
      const Cell& at = cell[plane];
      result[plane] = sum_corners(at, columns, in.features, [&at](int c) { return at.b(c); });
    }
  }
  // Where the columns of a plane stand in the encoded row of the point.
  __device__ int64_t place(int plane, int first) const {
    return n * in.width() + level * in.level_width() +
           (in.reduce == Reduce::kCat ? plane * in.n_features : 0) + first;
  }
  __device__ void store_planes(const float4 of_planes[kPlanes], const Columns& columns,
                               float* encoded) const {
#pragma unroll
    for (int plane = 0; plane < kPlanes; ++plane)
      store_some(encoded + place(plane, columns.first), of_planes[plane], columns.n);
  }
  // dL/dphi of the planes.
  __device__ void alpha(const float* grad_encoded, const Columns& columns, const float4 phi[kPlanes],
                        float4 result[kPlanes]) const {
#pragma unroll
    for (int plane = 0; plane < kPlanes; ++plane) {
      result[plane] = active ? load_some(grad_encoded + place(plane, columns.first), columns.n) : zero4();
      if (in.reduce == Reduce::kProd)
        result[plane] = result[plane] * phi[(plane + 1) % 3] * phi[(plane + 2) % 3];
    }
  }
};

// Adds what the warps of a block have for its points, in the order of the warps, to grad_points.
__device__ void add_over_warps(const float of_thread[3], int64_t n_points, float* grad_points) {
  SNH_SHARED(float, of_warps, kLevels * 3 * kWarp);
  for (int axis = 0; axis < 3; ++axis)
    of_warps[(threadIdx.y * 3 + axis) * kWarp + threadIdx.x] = of_thread[axis];
  __syncthreads();
  const int64_t n = static_cast<int64_t>(blockIdx.x) * kWarp + threadIdx.x;
  if (threadIdx.y != 0 || n >= n_points) return;
  for (int axis = 0; axis < 3; ++axis) {
    float sum = 0;
    for (int warp = 0; warp < static_cast<int>(blockDim.y); ++warp)
      sum += of_warps[(warp * 3 + axis) * kWarp + threadIdx.x];
    grad_points[3 * n + axis] += sum;
  }
}

__device__ void look_up(const View& view, float* encoded, bool* valid) {
  const Reduce reduce = view.in.reduce;
#pragma unroll
  for (int plane = 0; plane < kPlanes; ++plane)
    valid[(view.n * view.in.n_levels + view.level) * kPlanes + plane] = view.cell[plane].complete();
  for (int first = 0; first < view.in.n_features; first += 4) {
    const Columns columns = view.columns(first);
    float4 phi[kPlanes];
    view.phi(columns, phi);
    if (reduce == Reduce::kCat) {
      view.store_planes(phi, columns, encoded);
    } else {
      const float4 e = reduce == Reduce::kSum ? phi[0] + phi[1] + phi[2] : phi[0] * phi[1] * phi[2];
      store_some(encoded + view.place(0, first), e, columns.n);
    }
  }
}

__global__ void __launch_bounds__(kThreads) plane_lookup_kernel(Call call, float* encoded, bool* valid) {
  for (int level = threadIdx.y; level < call.in.n_levels; level += blockDim.y) {
    const View view(call, level);
    if (view.active) look_up(view, encoded, valid);
  }
}

__device__ void look_up_backward(const View& view, float inv_cell, const float* grad_encoded,
                                 bool need_points, float grad_point[3], float* grad_features) {
  for (int first = 0; first < view.in.n_features; first += 4) {
    const Columns columns = view.columns(first);
    float4 phi[kPlanes], alpha[kPlanes];
    if (view.in.reduce == Reduce::kProd) view.phi(columns, phi);
    view.alpha(grad_encoded, columns, phi, alpha);
#pragma unroll
    for (int plane = 0; plane < kPlanes; ++plane) {
      const Cell& at = view.cell[plane];
      const float4 a = alpha[plane];
      if (need_points) {
        const float4 f_p = sum_corners(at, columns, view.in.features, [&at](int c) { return at.b_p(c); });
        const float4 f_q = sum_corners(at, columns, view.in.features, [&at](int c) { return at.b_q(c); });
        grad_point[axis_u(plane)] += dot(a, f_p) * inv_cell;
        grad_point[axis_v(plane)] += dot(a, f_q) * inv_cell;
      }
      if (grad_features) scatter_corners(at, columns, grad_features, [&](int c) { return a * at.b(c); });
    }
  }
}

__global__ void __launch_bounds__(kThreads)
    backward_kernel(Call call, const float* grad_encoded, float* grad_points, float* grad_features) {
  float grad_point[3] = {0, 0, 0};
  for (int level = threadIdx.y; level < call.in.n_levels; level += blockDim.y)
    look_up_backward(View(call, level), call.inv_cells[level], grad_encoded, grad_points != nullptr,
                     grad_point, grad_features);
  if (grad_points) add_over_warps(grad_point, call.in.n_points, grad_points);
}

// The directions of the second derivative, null = zero, and where its results go.
struct Second {
  const float *grad_encoded, *v_points, *v_features;
  float *grad_grad_encoded, *grad_points, *grad_features;
};

__device__ void look_up_twice(const View& view, float inv_cell, const Second& second, float grad_point[3]) {
  float x_dot[3] = {0, 0, 0};  // in cells
  if (view.active && second.v_points)
    for (int axis = 0; axis < 3; ++axis) x_dot[axis] = second.v_points[3 * view.n + axis] * inv_cell;
  const Reduce reduce = view.in.reduce;
  for (int first = 0; first < view.in.n_features; first += 4) {
    const Columns columns = view.columns(first);
    float4 phi[kPlanes], phi_dot[kPlanes], alpha[kPlanes];
    view.phi(columns, phi);
#pragma unroll
    for (int plane = 0; plane < kPlanes; ++plane) {
      const Cell& at = view.cell[plane];
      const float p_dot = x_dot[axis_u(plane)], q_dot = x_dot[axis_v(plane)];
      const auto b_dot = [&](int c) { return at.b_p(c) * p_dot + at.b_q(c) * q_dot; };
      phi_dot[plane] = sum_corners(at, columns, view.in.features, b_dot);
      if (second.v_features)
        phi_dot[plane] =
            phi_dot[plane] + sum_corners(at, columns, second.v_features, [&at](int c) { return at.b(c); });
    }
    const auto product_dot = [&](int q, int r) { return phi_dot[q] * phi[r] + phi[q] * phi_dot[r]; };
    if (view.active && reduce == Reduce::kCat) view.store_planes(phi_dot, columns, second.grad_grad_encoded);
    if (view.active && reduce != Reduce::kCat)  // e_dot
      store_some(second.grad_grad_encoded + view.place(0, first),
                 reduce == Reduce::kSum ? phi_dot[0] + phi_dot[1] + phi_dot[2]
                                        : phi_dot[0] * phi[1] * phi[2] + phi[0] * product_dot(1, 2),
                 columns.n);
    view.alpha(second.grad_encoded, columns, phi, alpha);
#pragma unroll
    for (int plane = 0; plane < kPlanes; ++plane) {
      const Cell& at = view.cell[plane];
      const float4 a = alpha[plane];
      const float p_dot = x_dot[axis_u(plane)], q_dot = x_dot[axis_v(plane)];
      float4 beta = zero4();  // dPhi/dphi
      if (view.active && reduce == Reduce::kProd)
        beta = load_some(second.grad_encoded + view.place(0, first), columns.n) *
               product_dot((plane + 1) % 3, (plane + 2) % 3);

      const auto b_p = [&at](int c) { return at.b_p(c); };
      const auto b_q = [&at](int c) { return at.b_q(c); };
      const auto b_pq = [](int c) { return c == 0 || c == 3 ? 1.0f : -1.0f; };
      const float4 f_pq = sum_corners(at, columns, view.in.features, b_pq);
      const float4 f_p = sum_corners(at, columns, view.in.features, b_p);
      const float4 f_q = sum_corners(at, columns, view.in.features, b_q);
      float4 towards_p = f_pq * q_dot, towards_q = f_pq * p_dot;
      if (second.v_features) {
        towards_p = towards_p + sum_corners(at, columns, second.v_features, b_p);
        towards_q = towards_q + sum_corners(at, columns, second.v_features, b_q);
      }
      grad_point[axis_u(plane)] += (dot(a, towards_p) + dot(beta, f_p)) * inv_cell;
      grad_point[axis_v(plane)] += (dot(a, towards_q) + dot(beta, f_q)) * inv_cell;
      if (second.grad_features)
        scatter_corners(at, columns, second.grad_features,
                        [&](int c) { return a * (at.b_p(c) * p_dot + at.b_q(c) * q_dot) + beta * at.b(c); });
    }
  }
}

__global__ void __launch_bounds__(kThreads) double_backward_kernel(Call call, Second second) {
  float grad_point[3] = {0, 0, 0};
  for (int level = threadIdx.y; level < call.in.n_levels; level += blockDim.y)
    look_up_twice(View(call, level), call.inv_cells[level], second, grad_point);
  add_over_warps(grad_point, call.in.n_points, second.grad_points);
}

}  // namespace

void plane_lookup(const PlaneLookup<float>& in, float* encoded, bool* valid, Stream stream) {
  const Call call = make_call(in, nullptr);
  if (in.n_points == 0 || in.n_levels == 0) return;
  SNH_LAUNCH(plane_lookup_kernel, grid_of(call), block_of(call), 0, stream, call, encoded, valid);
}

void plane_lookup_backward(const PlaneLookup<float>& in, const float* grad_encoded, float* grad_points,
                           float* grad_features, Stream stream) {
  const Call call = make_call(in, grad_features);
  if (in.n_points == 0 || in.n_levels == 0) return;
  SNH_LAUNCH(backward_kernel, grid_of(call), block_of(call), 0, stream, call, grad_encoded, grad_points,
             grad_features);
}

void plane_lookup_double_backward(const PlaneLookup<float>& in, const float* grad_encoded,
                                  const float* v_points, const float* v_features, float* grad_grad_encoded,
                                  float* grad_points, float* grad_features, Stream stream) {
  Call call = make_call(in, grad_features);
  call.vector = call.vector && reinterpret_cast<uintptr_t>(v_features) % 16 == 0;
  if (in.n_points == 0 || in.n_levels == 0) return;
  const Second second{grad_encoded, v_points, v_features, grad_grad_encoded, grad_points, grad_features};
  SNH_LAUNCH(double_backward_kernel, grid_of(call), block_of(call), 0, stream, call, second);
}

}  // namespace snh::cuda
