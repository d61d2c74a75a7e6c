// Host shim: the vocabulary of CUDA kernels in plain C++, so that the very same .cu files run on a machine without a
// GPU. For tests; never part of a wheel. host_shim.cpp holds the fibers and the scheduler.
//
// A launch runs one block after the other. A CUDA thread runs until it ends or waits (barrier, warp operation); its
// stack is a fiber only then. The schedule (set_schedule) fixes the order of blocks, warps and lanes:
//
//   0          ascending
//   1          descending
//   2, 3, ...  seeds: blocks, warps and lanes shuffled, anew after each barrier; now and then a thread also gives
//              way before an atomic operation
//
// What is reported, as std::runtime_error that names the kernel: threads that wait for ever, threads of a block at two
// different barriers, lanes of a warp in different operations, a lane read that is not in the mask, bytes written
// behind dynamic shared memory. Shared memory is NaN at the start of each block, so a value that no thread of the block has
// written yet does not pass for a sum. Not seen: what needs threads that truly run at the same time (memory model,
// races between blocks), registers, occupancy.
//
// One launch at a time; not thread-safe.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <functional>
#include <type_traits>

// --- types --------------------------------------------------------------------------------------------------------

struct dim3 {
  unsigned x, y, z;
  constexpr dim3(unsigned x = 1, unsigned y = 1, unsigned z = 1) : x(x), y(y), z(z) {}
};
struct alignas(8) float2 {
  float x, y;
};
struct alignas(16) float4 {
  float x, y, z, w;
};
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(...)

namespace snh::shim {

// --- what a thread sees -------------------------------------------------------------------------------------------

struct Thread;  // one CUDA thread, see host_shim.cpp

struct Place {
  dim3 thread_idx{0, 0, 0}, block_idx{0, 0, 0}, block_dim, grid_dim;
};
extern Place place;              // of the thread that runs
extern uint64_t block_serial;    // counts blocks over all launches, from 1
extern void* dynamic_shared;     // of the block that runs
extern bool preempt_at_atomics;  // of the schedule

void set_schedule(uint64_t schedule);

// Runs body() as every thread of every block.
void launch(const char* kernel, dim3 grid, dim3 block, size_t shared_bytes,
            const std::function<void()>& body);

void barrier(const char* file, int line);
void give_way();
inline void before_atomic() {
  if (preempt_at_atomics) give_way();
}

inline void poison(void* memory, size_t bytes) { std::memset(memory, 0xFF, bytes); }

// Called where a static shared array is declared: new memory for each block.
inline void enter_shared(void* memory, size_t bytes, uint64_t& serial) {
  if (serial == block_serial) return;
  serial = block_serial;
  poison(memory, bytes);
}

// --- warp operations ----------------------------------------------------------------------------------------------

enum class WarpOp { kSync, kShuffle, kVote, kMatch };

// What all lanes of `mask` brought, from the moment on that the last of them arrived.
class Exchange {
 public:
  Exchange(unsigned mask, WarpOp op, uint64_t value);  // waits
  ~Exchange();
  int lane() const { return lane_; }
  uint64_t of(int lane) const;  // reports a lane that is not in the mask
  template <typename Predicate>
  unsigned lanes_where(const Predicate& holds) const {
    unsigned found = 0;
    for (int l = 0; l < 32; ++l)
      if (mask_ >> l & 1 && holds(of(l))) found |= 1u << l;
    return found;
  }

 private:
  unsigned mask_;
  int lane_;
  struct Board* board_;
};

template <typename T>
uint64_t to_bits(T value) {
  static_assert(std::is_trivially_copyable_v<T> && sizeof(T) <= 8, "a lane exchanges 4 or 8 bytes");
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof(T));
  return bits;
}

// `source` gives the lane to read, from the own lane.
template <typename T, typename Source>
T shuffle(unsigned mask, T value, const Source& source) {
  const Exchange exchange(mask, WarpOp::kShuffle, to_bits(value));
  const uint64_t bits = exchange.of(source(exchange.lane()));
  T result;
  std::memcpy(&result, &bits, sizeof(T));
  return result;
}

}  // namespace snh::shim

#define threadIdx (::snh::shim::place.thread_idx)
#define blockIdx (::snh::shim::place.block_idx)
#define blockDim (::snh::shim::place.block_dim)
#define gridDim (::snh::shim::place.grid_dim)

#define __syncthreads() ::snh::shim::barrier(__FILE__, __LINE__)

inline void __syncwarp(unsigned mask = ~0u) {
  const snh::shim::Exchange all(mask, snh::shim::WarpOp::kSync, 0);
}
template <typename T>
T __shfl_sync(unsigned mask, T value, int source) {
  return snh::shim::shuffle(mask, value, [source](int) { return source & 31; });
}
template <typename T>
T __shfl_xor_sync(unsigned mask, T value, int bits) {
  return snh::shim::shuffle(mask, value, [bits](int lane) { return (lane ^ bits) & 31; });
}
template <typename T>
T __shfl_up_sync(unsigned mask, T value, unsigned by) {
  return snh::shim::shuffle(mask, value, [by](int lane) { return lane < int(by) ? lane : lane - int(by); });
}
template <typename T>
T __shfl_down_sync(unsigned mask, T value, unsigned by) {
  return snh::shim::shuffle(mask, value,
                            [by](int lane) { return lane + int(by) > 31 ? lane : lane + int(by); });
}
inline unsigned __ballot_sync(unsigned mask, int holds) {
  const snh::shim::Exchange vote(mask, snh::shim::WarpOp::kVote, holds != 0);
  return vote.lanes_where([](uint64_t bit) { return bit != 0; });
}
inline int __any_sync(unsigned mask, int holds) { return __ballot_sync(mask, holds) != 0; }
inline int __all_sync(unsigned mask, int holds) { return __ballot_sync(mask, holds) == mask; }
template <typename T>
unsigned __match_any_sync(unsigned mask, T value) {
  const uint64_t own = snh::shim::to_bits(value);
  const snh::shim::Exchange match(mask, snh::shim::WarpOp::kMatch, own);
  return match.lanes_where([own](uint64_t other) { return other == own; });
}

// --- atomic operations --------------------------------------------------------------------------------------------

namespace snh::shim {
template <typename T, typename Change>
T atomic(T* target, const Change& change) {
  before_atomic();
  const T old = *target;
  *target = change(old);
  return old;
}
template <typename T>
using Same = std::common_type_t<T>;  // no deduction from this argument
}  // namespace snh::shim

template <typename T>
T atomicAdd(T* target, snh::shim::Same<T> value) {
  return snh::shim::atomic(target, [value](T old) { return old + value; });
}
template <typename T>
T atomicMin(T* target, snh::shim::Same<T> value) {
  return snh::shim::atomic(target, [value](T old) { return std::min(old, value); });
}
template <typename T>
T atomicMax(T* target, snh::shim::Same<T> value) {
  return snh::shim::atomic(target, [value](T old) { return std::max(old, value); });
}
template <typename T>
T atomicOr(T* target, snh::shim::Same<T> value) {
  return snh::shim::atomic(target, [value](T old) { return old | value; });
}
template <typename T>
T atomicCAS(T* target, snh::shim::Same<T> expected, snh::shim::Same<T> value) {
  return snh::shim::atomic(target, [=](T old) { return old == expected ? value : old; });
}

// --- arithmetic ---------------------------------------------------------------------------------------------------

inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __popcll(unsigned long long bits) { return __builtin_popcountll(bits); }
inline int __ffs(unsigned bits) { return __builtin_ffs(static_cast<int>(bits)); }
inline int __clz(unsigned bits) { return bits ? __builtin_clz(bits) : 32; }
// One rounding each: the compiler must not fuse them. Built with -ffp-contract=off.
inline float __fmul_rn(float a, float b) { return a * b; }
inline float __fadd_rn(float a, float b) { return a + b; }
inline float __fsub_rn(float a, float b) { return a - b; }
