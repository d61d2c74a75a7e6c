#include "hash_table/hash_table.h"

#include "common/check.h"
#include "common/cuda_torch.h"
#include "common/key.h"

namespace snh {

namespace {

void check_keys(const char* op, const char* arg, const Tensor& keys) {
  check_dtype(op, arg, keys, ScalarType::Long);
  check_shape(op, arg, keys, {-1});
}

void check_capacity(const char* op, int64_t capacity, int64_t n_bricks) {
  STD_TORCH_CHECK(capacity > n_bricks && (capacity & (capacity - 1)) == 0 && capacity <= (int64_t(1) << 31),
                  "snh::", op, ": the probe array must have a power of two places, more than the ", n_bricks,
                  " bricks, got ", capacity);
}

void check_probe(const char* op, const Tensor& probe, int64_t n_bricks) {
  check_dtype(op, "probe", probe, ScalarType::Int);
  check_shape(op, "probe", probe, {-1});
  check_capacity(op, probe.size(0), n_bricks);
}

void check_in_place(const char* op, const char* arg, const Tensor& t) {
  STD_TORCH_CHECK(t.is_contiguous(), "snh::", op, ": argument '", arg,
                  "' is written in place and must be contiguous");
}

Tensor hash_table_build(const Tensor& brick_keys, int64_t capacity) {
  constexpr const char* kOp = "hash_table_build";
  const DeviceScope scope(kOp, {{"brick_keys", brick_keys}});
  check_keys(kOp, "brick_keys", brick_keys);
  check_capacity(kOp, capacity, brick_keys.size(0));
  const Tensor keys = torch::stable::contiguous(brick_keys);
  Tensor probe = torch::stable::new_empty(keys, {capacity}, ScalarType::Int);
  int64_t placed = 0;
  if (scope.on_cuda()) {
    const Tensor workspace = torch::stable::new_empty(keys, {1});
    SNH_KERNELS(placed = cuda::hash_table_build(in<int64_t>(keys), keys.size(0), out<int32_t>(probe),
                                                capacity, out<int64_t>(workspace), scope.stream());)
  } else {
    placed = cpu::hash_table_build(in<int64_t>(keys), keys.size(0), out<int32_t>(probe), capacity);
  }
  STD_TORCH_CHECK(placed == keys.size(0), "snh::", kOp,
                  ": argument 'brick_keys' must not repeat a key, entry ", placed, " does");
  return probe;
}

Tensor hash_table_numbers(const Tensor& probe, const Tensor& brick_keys, const Tensor& keys) {
  constexpr const char* kOp = "hash_table_numbers";
  const DeviceScope scope(kOp, {{"probe", probe}, {"brick_keys", brick_keys}, {"keys", keys}});
  check_keys(kOp, "brick_keys", brick_keys);
  check_probe(kOp, probe, 0);
  check_keys(kOp, "keys", keys);
  const Tensor p = torch::stable::contiguous(probe), b = torch::stable::contiguous(brick_keys);
  const Tensor k = torch::stable::contiguous(keys);
  Tensor numbers = torch::stable::new_empty(k, {k.size(0)}, ScalarType::Int);
  if (scope.on_cuda()) {
    SNH_KERNELS(cuda::hash_table_numbers(in<int64_t>(k), k.size(0), in<int32_t>(p), p.size(0), in<int64_t>(b),
                                         out<int32_t>(numbers), scope.stream());)
    return numbers;
  }
  cpu::hash_table_numbers(in<int64_t>(k), k.size(0), in<int32_t>(p), p.size(0), in<int64_t>(b),
                          out<int32_t>(numbers));
  return numbers;
}

// brick_keys and masks are storage: rows from n_bricks on are room for new bricks.
void hash_table_insert_(Tensor probe, Tensor brick_keys, Tensor masks, int64_t n_bricks, const Tensor& keys,
                        const Tensor& new_masks) {
  constexpr const char* kOp = "hash_table_insert_";
  const DeviceScope scope(kOp, {{"probe", probe},
                                {"brick_keys", brick_keys},
                                {"masks", masks},
                                {"keys", keys},
                                {"new_masks", new_masks}});
  check_keys(kOp, "keys", keys);
  check_dtype(kOp, "new_masks", new_masks, ScalarType::Long);
  check_shape(kOp, "new_masks", new_masks, {keys.size(0)});
  check_keys(kOp, "brick_keys", brick_keys);
  check_dtype(kOp, "masks", masks, ScalarType::Long);
  check_shape(kOp, "masks", masks, {brick_keys.size(0)});
  check_in_place(kOp, "probe", probe);
  check_in_place(kOp, "brick_keys", brick_keys);
  check_in_place(kOp, "masks", masks);
  const Tensor k = torch::stable::contiguous(keys), m = torch::stable::contiguous(new_masks);
  check_probe(kOp, probe, 0);
  const int64_t n_keys = k.size(0);

  KeyCheck check{};
  if (scope.on_cuda()) {
    const Tensor workspace = torch::stable::new_empty(k, {2});
    SNH_KERNELS(check =
                    cuda::hash_table_check(in<int64_t>(k), n_keys, in<int32_t>(probe), probe.size(0),
                                           in<int64_t>(brick_keys), out<int64_t>(workspace), scope.stream());)
  } else {
    check = cpu::hash_table_check(in<int64_t>(k), n_keys, in<int32_t>(probe), probe.size(0),
                                  in<int64_t>(brick_keys));
  }
  // Insertion numbers bricks in the order in which they come, so a wrong order would depend on the caller.
  STD_TORCH_CHECK(check.first_wrong == n_keys, "snh::", kOp,
                  ": argument 'keys' must be non-negative and strictly ascending, entry ", check.first_wrong,
                  " is not");
  const int64_t n_after = n_bricks + check.n_missing;
  check_probe(kOp, probe, n_after);
  STD_TORCH_CHECK(n_bricks >= 0 && n_after <= brick_keys.size(0), "snh::", kOp, ": the storage holds ",
                  brick_keys.size(0), " bricks, but ", n_after, " are needed");
  if (scope.on_cuda()) {
    const Tensor numbers = torch::stable::new_empty(k, {n_keys}, ScalarType::Int);
    const Tensor workspace = torch::stable::new_empty(k, {1});
    SNH_KERNELS(cuda::hash_table_insert(in<int64_t>(k), in<int64_t>(m), n_keys, n_bricks, out<int32_t>(probe),
                                        probe.size(0), out<int64_t>(brick_keys), out<int64_t>(masks),
                                        out<int32_t>(numbers), out<int64_t>(workspace), scope.stream());)
    return;
  }
  cpu::hash_table_insert(in<int64_t>(k), in<int64_t>(m), n_keys, n_bricks, out<int32_t>(probe), probe.size(0),
                         out<int64_t>(brick_keys), out<int64_t>(masks));
}

Tensor hash_table_find(const Tensor& probe, const Tensor& brick_keys, const Tensor& masks,
                       const Tensor& vertices) {
  constexpr const char* kOp = "hash_table_find";
  const DeviceScope scope(
      kOp, {{"probe", probe}, {"brick_keys", brick_keys}, {"masks", masks}, {"vertices", vertices}});
  check_keys(kOp, "brick_keys", brick_keys);
  check_probe(kOp, probe, 0);
  check_dtype(kOp, "masks", masks, ScalarType::Long);
  check_shape(kOp, "masks", masks, {brick_keys.size(0)});
  check_dtype(kOp, "vertices", vertices, ScalarType::Long);
  check_shape(kOp, "vertices", vertices, {-1, 4});
  const Tensor p = torch::stable::contiguous(probe), b = torch::stable::contiguous(brick_keys);
  const Tensor m = torch::stable::contiguous(masks), v = torch::stable::contiguous(vertices);
  Tensor slots = torch::stable::new_empty(v, {v.size(0)});
  if (scope.on_cuda()) {
    SNH_KERNELS(cuda::hash_table_find(in<int64_t>(v), v.size(0), in<int32_t>(p), p.size(0), in<int64_t>(b),
                                      in<int64_t>(m), out<int64_t>(slots), scope.stream());)
    return slots;
  }
  torch_parallel_for(16384)(v.size(0), [&](int64_t begin, int64_t end) {
    cpu::hash_table_find(in<int64_t>(v) + 4 * begin, end - begin, in<int32_t>(p), p.size(0), in<int64_t>(b),
                         in<int64_t>(m), out<int64_t>(slots) + begin);
  });
  return slots;
}

}  // namespace

}  // namespace snh

SNH_OPS(m) {
  m.def("hash_table_build(Tensor brick_keys, int capacity) -> Tensor");
  m.def("hash_table_numbers(Tensor probe, Tensor brick_keys, Tensor keys) -> Tensor");
  m.def(
      "hash_table_insert_(Tensor(a!) probe, Tensor(b!) brick_keys, Tensor(c!) masks, int n_bricks, Tensor "
      "keys, "
      "Tensor new_masks) -> ()");
  m.def("hash_table_find(Tensor probe, Tensor brick_keys, Tensor masks, Tensor vertices) -> Tensor");
}
SNH_OPS_IMPL(m) {
  m.impl("hash_table_build", TORCH_BOX(&snh::hash_table_build));
  m.impl("hash_table_numbers", TORCH_BOX(&snh::hash_table_numbers));
  m.impl("hash_table_insert_", TORCH_BOX(&snh::hash_table_insert_));
  m.impl("hash_table_find", TORCH_BOX(&snh::hash_table_find));
}
