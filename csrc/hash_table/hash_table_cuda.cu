// The same table as the CPU's, bit for bit, though all bricks are placed at once: of two bricks that meet at a place,
// the one with the lower number stays and the other walks on, which is where one-by-one insertion in ascending order
// would have put them (Blelloch and Shun's "deterministic phase-concurrent hash tables").
#include "common/kernel.cuh"
#include "common/key.h"
#include "common/lattice.h"
#include "hash_table/hash_table.h"

namespace snh::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kScanThreads = 1024;

__device__ uint32_t first_place(int64_t key) {
  const Brick brick = unpack_key(key);
  return hash_brick(static_cast<uint32_t>(brick.level * 4 + brick.plane), brick.i, brick.j);
}

__device__ int32_t number_of(int64_t key, const int32_t* probe, int64_t capacity, const int64_t* brick_keys) {
  const Brick brick = unpack_key(key);
  return find_brick(brick.level, brick.plane, brick.i, brick.j, probe, capacity, brick_keys);
}

__device__ void place_brick(int64_t key, int32_t number, int32_t* probe, int64_t capacity) {
  const uint32_t last = static_cast<uint32_t>(capacity - 1);
  for (uint32_t place = first_place(key) & last;; place = (place + 1) & last) {
    int32_t seen = probe[place];
    while (seen < 0 || seen > number) {
      const int32_t before = atomicCAS(&probe[place], seen, number);
      if (before == seen) {
        if (seen < 0) return;
        number = seen;  // the one that had to leave: it goes on from here
        break;
      }
      seen = before;
    }
  }
}

__global__ void __launch_bounds__(kThreads)
    place_kernel(const int64_t* brick_keys, int64_t first, const int64_t* n, int64_t n_most, int32_t* probe,
                 int64_t capacity) {
  const int64_t k = global_thread();
  if (k >= n_most || (n && k >= *n)) return;
  place_brick(brick_keys[first + k], static_cast<int32_t>(first + k), probe, capacity);
}

// The lowest brick whose key a lower one has too. A look-up meets the lower of the two first.
__global__ void __launch_bounds__(kThreads)
    repeated_kernel(const int64_t* brick_keys, int64_t n_bricks, const int32_t* probe, int64_t capacity,
                    unsigned long long* lowest) {
  const int64_t b = global_thread();
  if (b >= n_bricks) return;
  if (number_of(brick_keys[b], probe, capacity, brick_keys) != b)
    atomicMin(lowest, static_cast<unsigned long long>(b));
}

__global__ void __launch_bounds__(kThreads)
    numbers_kernel(const int64_t* keys, int64_t n_keys, const int32_t* probe, int64_t capacity,
                   const int64_t* brick_keys, int32_t* numbers) {
  const int64_t m = global_thread();
  if (m >= n_keys) return;
  numbers[m] = number_of(keys[m], probe, capacity, brick_keys);
}

// One block. Gives the keys without a number the next ones in their order, and their bricks an empty mask; counts them.
__global__ void __launch_bounds__(kScanThreads)
    number_new_kernel(const int64_t* keys, int64_t n_keys, int64_t n_bricks, int32_t* numbers,
                      int64_t* brick_keys, int64_t* masks, int64_t* n_new) {
  SNH_SHARED(int, warp_counts, kWarp);
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  int64_t next = n_bricks;
  for (int64_t first = 0; first < n_keys; first += kScanThreads) {
    const int64_t m = first + threadIdx.x;
    const bool is_new = m < n_keys && numbers[m] < 0;
    const unsigned votes = __ballot_sync(kFullMask, is_new);
    if (lane == 0) warp_counts[warp] = __popc(votes);
    __syncthreads();
    int before = __popc(votes & ((1u << lane) - 1)), total = 0;
    for (int w = 0; w < kScanThreads / kWarp; ++w) {
      if (w < warp) before += warp_counts[w];
      total += warp_counts[w];
    }
    if (is_new) {
      numbers[m] = static_cast<int32_t>(next + before);
      brick_keys[next + before] = keys[m];
      masks[next + before] = 0;
    }
    next += total;
    __syncthreads();  // before the counts are written again
  }
  if (threadIdx.x == 0) *n_new = next - n_bricks;
}

// Keys differ, so no two threads meet at a brick.
__global__ void __launch_bounds__(kThreads)
    add_masks_kernel(const int32_t* numbers, const int64_t* new_masks, int64_t n_keys, int64_t* masks) {
  const int64_t m = global_thread();
  if (m >= n_keys) return;
  masks[numbers[m]] |= new_masks[m];
}

__device__ bool in_key_range(const int64_t* vertex) {
  constexpr int64_t kLimit = static_cast<int64_t>(kBrickOffset) * kBrickSide;
  return 0 <= vertex[0] && vertex[0] < kMaxLevels && 0 <= vertex[1] && vertex[1] < kPlanes &&
         -kLimit <= vertex[2] && vertex[2] < kLimit && -kLimit <= vertex[3] && vertex[3] < kLimit;
}

__global__ void __launch_bounds__(kThreads)
    find_kernel(const int64_t* vertices, int64_t n_vertices, const int32_t* probe, int64_t capacity,
                const int64_t* brick_keys, const int64_t* masks, int64_t* slots) {
  const int64_t n = global_thread();
  if (n >= n_vertices) return;
  const int64_t* v = vertices + 4 * n;
  slots[n] = in_key_range(v)
                 ? find_slot(static_cast<int>(v[0]), static_cast<int>(v[1]), static_cast<int32_t>(v[2]),
                             static_cast<int32_t>(v[3]), probe, capacity, brick_keys, masks)
                 : -1;
}

// Where the keys first fail to ascend, and how many are not in the table.
__global__ void __launch_bounds__(kThreads)
    check_keys_kernel(const int64_t* keys, int64_t n_keys, const int32_t* probe, int64_t capacity,
                      const int64_t* brick_keys, unsigned long long* first_wrong,
                      unsigned long long* n_missing) {
  const int64_t m = global_thread();
  if (m >= n_keys) return;
  if (keys[m] <= (m ? keys[m - 1] : -1))
    return void(atomicMin(first_wrong, static_cast<unsigned long long>(m)));
  if (number_of(keys[m], probe, capacity, brick_keys) < 0) atomicAdd(n_missing, 1ull);
}

}  // namespace

int64_t hash_table_build(const int64_t* brick_keys, int64_t n_bricks, int32_t* probe, int64_t capacity,
                         int64_t workspace[1], Stream stream) {
  set_bytes(probe, 0xFF, capacity * sizeof(int32_t), stream);
  if (n_bricks == 0) return 0;
  auto* lowest = reinterpret_cast<unsigned long long*>(workspace);
  set_bytes(lowest, 0xFF, sizeof *lowest, stream);
  SNH_LAUNCH(place_kernel, blocks_for(n_bricks, kThreads), kThreads, 0, stream, brick_keys, int64_t{0},
             nullptr, n_bricks, probe, capacity);
  SNH_LAUNCH(repeated_kernel, blocks_for(n_bricks, kThreads), kThreads, 0, stream, brick_keys, n_bricks,
             probe, capacity, lowest);
  unsigned long long repeated;
  copy_to_host(&repeated, lowest, sizeof repeated, stream);
  return repeated == ~0ull ? n_bricks : static_cast<int64_t>(repeated);
}

void hash_table_numbers(const int64_t* keys, int64_t n_keys, const int32_t* probe, int64_t capacity,
                        const int64_t* brick_keys, int32_t* numbers, Stream stream) {
  if (n_keys == 0) return;
  SNH_LAUNCH(numbers_kernel, blocks_for(n_keys, kThreads), kThreads, 0, stream, keys, n_keys, probe, capacity,
             brick_keys, numbers);
}

KeyCheck hash_table_check(const int64_t* keys, int64_t n_keys, const int32_t* probe, int64_t capacity,
                          const int64_t* brick_keys, int64_t workspace[2], Stream stream) {
  if (n_keys == 0) return {0, 0};
  auto* counts = reinterpret_cast<unsigned long long*>(workspace);
  set_bytes(counts, 0xFF, sizeof *counts, stream);
  set_bytes(counts + 1, 0, sizeof *counts, stream);
  SNH_LAUNCH(check_keys_kernel, blocks_for(n_keys, kThreads), kThreads, 0, stream, keys, n_keys, probe,
             capacity, brick_keys, counts, counts + 1);
  unsigned long long found[2];
  copy_to_host(found, counts, sizeof found, stream);
  return {found[0] == ~0ull ? n_keys : static_cast<int64_t>(found[0]), static_cast<int64_t>(found[1])};
}

void hash_table_insert(const int64_t* keys, const int64_t* new_masks, int64_t n_keys, int64_t n_bricks,
                       int32_t* probe, int64_t capacity, int64_t* brick_keys, int64_t* masks,
                       int32_t* numbers, int64_t workspace[1], Stream stream) {
  if (n_keys == 0) return;
  int64_t* const n_new = workspace;
  const unsigned blocks = blocks_for(n_keys, kThreads);
  SNH_LAUNCH(numbers_kernel, blocks, kThreads, 0, stream, keys, n_keys, probe, capacity, brick_keys, numbers);
  SNH_LAUNCH(number_new_kernel, 1, kScanThreads, 0, stream, keys, n_keys, n_bricks, numbers, brick_keys,
             masks, n_new);
  SNH_LAUNCH(place_kernel, blocks, kThreads, 0, stream, brick_keys, n_bricks, n_new, n_keys, probe, capacity);
  SNH_LAUNCH(add_masks_kernel, blocks, kThreads, 0, stream, numbers, new_masks, n_keys, masks);
}

void hash_table_find(const int64_t* vertices, int64_t n_vertices, const int32_t* probe, int64_t capacity,
                     const int64_t* brick_keys, const int64_t* masks, int64_t* slots, Stream stream) {
  if (n_vertices == 0) return;
  SNH_LAUNCH(find_kernel, blocks_for(n_vertices, kThreads), kThreads, 0, stream, vertices, n_vertices, probe,
             capacity, brick_keys, masks, slots);
}

}  // namespace snh::cuda
