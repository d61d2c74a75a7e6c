// Fibers and scheduler of the host shim; what it promises stands in host_shim.h.
#include "common/host_shim.h"

#include <cstdlib>
#include <memory>
#include <numeric>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/common_interface_defs.h>
#define SNH_ASAN 1
#else
#define SNH_ASAN 0
#endif

#if !defined(__x86_64__) && !defined(__aarch64__)
#include <ucontext.h>
#endif

#if defined(__x86_64__) || defined(__aarch64__)
extern "C" void snh_shim_switch(void** from, void* to);
#endif

namespace snh::shim {

Place place;
uint64_t block_serial = 0;
void* dynamic_shared = nullptr;
bool preempt_at_atomics = false;

namespace {

// --- fibers -------------------------------------------------------------------------------------------------------

constexpr size_t kStackBytes = SNH_ASAN ? 512 << 10 : 128 << 10;

#if defined(__x86_64__) || defined(__aarch64__)
using Context = void*;  // stack pointer; the registers that a call must keep lie on the stack
#if defined(__x86_64__)
asm(R"(
.text
.local snh_shim_switch
.type snh_shim_switch, @function
snh_shim_switch:
  pushq %rbp
  pushq %rbx
  pushq %r12
  pushq %r13
  pushq %r14
  pushq %r15
  movq %rsp, (%rdi)
  movq %rsi, %rsp
  popq %r15
  popq %r14
  popq %r13
  popq %r12
  popq %rbx
  popq %rbp
  ret
.size snh_shim_switch, .-snh_shim_switch
)");
constexpr int kSavedWords = 6, kReturnWord = 6,
              kFrameWords = 8;  // entry as after a call: 8 below a multiple of 16
#else
asm(R"(
.text
.local snh_shim_switch
.type snh_shim_switch, %function
snh_shim_switch:
  sub sp, sp, #160
  stp x19, x20, [sp]
  stp x21, x22, [sp, #16]
  stp x23, x24, [sp, #32]
  stp x25, x26, [sp, #48]
  stp x27, x28, [sp, #64]
  stp x29, x30, [sp, #80]
  stp d8, d9, [sp, #96]
  stp d10, d11, [sp, #112]
  stp d12, d13, [sp, #128]
  stp d14, d15, [sp, #144]
  mov x2, sp
  str x2, [x0]
  mov sp, x1
  ldp x19, x20, [sp]
  ldp x21, x22, [sp, #16]
  ldp x23, x24, [sp, #32]
  ldp x25, x26, [sp, #48]
  ldp x27, x28, [sp, #64]
  ldp x29, x30, [sp, #80]
  ldp d8, d9, [sp, #96]
  ldp d10, d11, [sp, #112]
  ldp d12, d13, [sp, #128]
  ldp d14, d15, [sp, #144]
  add sp, sp, #160
  ret
.size snh_shim_switch, .-snh_shim_switch
)");
constexpr int kSavedWords = 20, kReturnWord = 11, kFrameWords = 20;
#endif

void make_context(Context& context, char* stack, void (*entry)()) {
  auto top = reinterpret_cast<uintptr_t>(stack + kStackBytes) & ~uintptr_t{15};
  auto* frame = reinterpret_cast<uintptr_t*>(top) - kFrameWords;
  std::fill_n(frame, kSavedWords, 0);
  frame[kReturnWord] = reinterpret_cast<uintptr_t>(entry);
  context = frame;
}
void switch_context(Context& from, Context& to) { snh_shim_switch(&from, to); }
#else
using Context = ucontext_t;
void make_context(Context& context, char* stack, void (*entry)()) {
  getcontext(&context);
  context.uc_stack.ss_sp = stack;
  context.uc_stack.ss_size = kStackBytes;
  makecontext(&context, entry, 0);
}
void switch_context(Context& from, Context& to) { swapcontext(&from, &to); }
#endif

struct Fiber {
  std::unique_ptr<char[]> stack{new char[kStackBytes]};
  Context context{};
};

}  // namespace

// --- threads and warps --------------------------------------------------------------------------------------------

enum class State { kReady, kAtBarrier, kInWarpOp, kDone };

struct Thread {
  Place place;
  int warp = 0, lane = 0;
  State state = State::kReady;
  Fiber* fiber = nullptr;
  // While it waits:
  const char* file = nullptr;
  int line = 0;
  unsigned mask = 0;
  WarpOp op = WarpOp::kSync;
  uint64_t value = 0;
  Board* board = nullptr;
};

// The values of one complete warp operation, until the last lane has left it.
struct Board {
  uint64_t values[32];
  int readers = 0;
};

namespace {

struct Warp {
  Thread* lanes[32] = {};
  unsigned waiting = 0;  // lanes in a warp operation
  Board boards[32];
};

// The launch under way.
struct Launch {
  const char* kernel;
  const std::function<void()>* body;
  std::vector<Thread> threads;
  std::vector<Warp> warps;
  std::vector<int> order;  // of the threads
  Thread* running = nullptr;
  Context scheduler{};
  std::string error;
  const void* scheduler_stack = nullptr;  // for AddressSanitizer
  size_t scheduler_stack_bytes = 0;
};

uint64_t schedule = 0;
std::mt19937_64 random_source;
Launch* current = nullptr;
std::vector<std::unique_ptr<Fiber>> fibers;
std::vector<Fiber*> idle_fibers;

void to_thread(Thread& thread) {
  current->running = &thread;
  place = thread.place;
#if SNH_ASAN
  void* fake_stack = nullptr;
  __sanitizer_start_switch_fiber(&fake_stack, thread.fiber->stack.get(), kStackBytes);
#endif
  switch_context(current->scheduler, thread.fiber->context);
#if SNH_ASAN
  __sanitizer_finish_switch_fiber(fake_stack, nullptr, nullptr);
#endif
}

void to_scheduler() {
  Fiber& fiber = *current->running->fiber;
#if SNH_ASAN
  void* fake_stack = nullptr;
  __sanitizer_start_switch_fiber(&fake_stack, current->scheduler_stack, current->scheduler_stack_bytes);
#endif
  switch_context(fiber.context, current->scheduler);
#if SNH_ASAN
  __sanitizer_finish_switch_fiber(fake_stack, &current->scheduler_stack, &current->scheduler_stack_bytes);
#endif
}

// A fiber runs one thread after the other.
void run_fiber() {
#if SNH_ASAN
  __sanitizer_finish_switch_fiber(nullptr, &current->scheduler_stack, &current->scheduler_stack_bytes);
#endif
  while (true) {
    (*current->body)();
    current->running->state = State::kDone;
    to_scheduler();
  }
}

Fiber* take_fiber() {
  if (idle_fibers.empty()) {
    fibers.push_back(std::make_unique<Fiber>());
    make_context(fibers.back()->context, fibers.back()->stack.get(), run_fiber);
    idle_fibers.push_back(fibers.back().get());
  }
  Fiber* fiber = idle_fibers.back();
  idle_fibers.pop_back();
  return fiber;
}

std::string name_of(const dim3& d) {
  return "(" + std::to_string(d.x) + ", " + std::to_string(d.y) + ", " + std::to_string(d.z) + ")";
}

std::string name_of(const Thread& thread) {
  return "thread " + name_of(thread.place.thread_idx) + " of block " + name_of(thread.place.block_idx);
}

// From a thread: ends the launch.
void fail(const std::string& what) {
  current->error = name_of(*current->running) + " " + what;
  to_scheduler();
  std::abort();  // never resumed
}

[[noreturn]] void fail_launch(const std::string& what) {
  const std::string kernel = current->kernel;
  idle_fibers.clear();  // their stacks hold threads that never ended
  fibers.clear();
  current = nullptr;
  throw std::runtime_error("host shim: kernel " + kernel + ": " + what);
}

// --- scheduler ----------------------------------------------------------------------------------------------------

std::vector<int> ordered(int n) {
  std::vector<int> order(n);
  std::iota(order.begin(), order.end(), 0);
  if (schedule == 1) std::reverse(order.begin(), order.end());
  if (schedule >= 2) std::shuffle(order.begin(), order.end(), random_source);
  return order;
}

void order_threads() {
  current->order.clear();
  for (const int warp : ordered(static_cast<int>(current->warps.size())))
    for (const int lane : ordered(32))
      if (current->warps[warp].lanes[lane]) current->order.push_back(warp * 32 + lane);
}

void open_barrier() {
  Thread* first = nullptr;
  for (Thread& thread : current->threads) {
    if (thread.state != State::kAtBarrier) continue;
    if (!first) first = &thread;
    if (thread.line != first->line || thread.file != first->file)
      fail_launch(name_of(*first) + " waits at the barrier in line " + std::to_string(first->line) + ", " +
                  name_of(thread) + " at another in line " + std::to_string(thread.line));
    thread.state = State::kReady;
  }
  if (schedule >= 2) order_threads();
}

void check_stuck() {
  for (const Thread& thread : current->threads)
    if (thread.state == State::kInWarpOp)
      fail_launch(name_of(thread) +
                  " waits for ever in a warp operation, as lanes of its mask have ended or wait "
                  "elsewhere");
}

void run_block(dim3 block_idx) {
  ++block_serial;
  for (Warp& warp : current->warps) warp.waiting = 0;
  for (Thread& thread : current->threads) {
    thread.place.block_idx = block_idx;
    thread.state = State::kReady;
  }
  order_threads();
  size_t live = current->threads.size();
  while (live) {
    bool progress = false;
    for (size_t k = 0; k < current->order.size(); ++k) {
      Thread& thread = current->threads[current->order[k]];
      if (thread.state != State::kReady) continue;
      progress = true;
      if (!thread.fiber) thread.fiber = take_fiber();
      to_thread(thread);
      if (!current->error.empty()) fail_launch(current->error);
      if (thread.state != State::kDone) continue;
      idle_fibers.push_back(thread.fiber);
      thread.fiber = nullptr;
      --live;
    }
    if (progress || !live) continue;
    check_stuck();
    open_barrier();
  }
}

// Dynamic shared memory with a fence behind it.
struct SharedMemory {
  static constexpr size_t kFence = SNH_ASAN ? 0 : 64;  // AddressSanitizer has its own
  explicit SharedMemory(size_t bytes) : bytes(bytes), memory(new float4[(bytes + kFence) / 16 + 1]) {
    dynamic_shared = bytes ? memory.get() : nullptr;
  }
  void renew() { poison(memory.get(), bytes + kFence); }
  bool intact() const {
    const auto* end = reinterpret_cast<const unsigned char*>(memory.get()) + bytes;
    return std::all_of(end, end + kFence, [](unsigned char byte) { return byte == 0xFF; });
  }
  size_t bytes;
  std::unique_ptr<float4[]> memory;
};

}  // namespace

void set_schedule(uint64_t number) {
  schedule = number;
  preempt_at_atomics = number >= 2;
  random_source.seed(number);
}

void launch(const char* kernel, dim3 grid, dim3 block, size_t shared_bytes,
            const std::function<void()>& body) {
  const int n_threads = static_cast<int>(block.x * block.y * block.z);
  Launch state{};
  state.kernel = kernel;
  state.body = &body;
  current = &state;
  if (n_threads < 1 || n_threads > 1024) fail_launch("a block of " + std::to_string(n_threads) + " threads");
  state.threads.resize(n_threads);
  state.warps.resize((n_threads + 31) / 32);
  for (int k = 0; k < n_threads; ++k) {
    Thread& thread = state.threads[k];
    const unsigned u = static_cast<unsigned>(k);
    thread.place = {{u % block.x, u / block.x % block.y, u / (block.x * block.y)}, {}, block, grid};
    thread.warp = k / 32;
    thread.lane = k % 32;
    state.warps[thread.warp].lanes[thread.lane] = &thread;
  }
  SharedMemory shared(shared_bytes);
  const int64_t n_blocks = int64_t(grid.x) * grid.y * grid.z;
  for (const int b : ordered(static_cast<int>(n_blocks))) {
    const unsigned u = static_cast<unsigned>(b);
    shared.renew();
    run_block({u % grid.x, u / grid.x % grid.y, u / (grid.x * grid.y)});
    if (!shared.intact()) fail_launch("writes behind its dynamic shared memory");
  }
  current = nullptr;
}

void barrier(const char* file, int line) {
  Thread& self = *current->running;
  self.state = State::kAtBarrier;
  self.file = file;
  self.line = line;
  to_scheduler();
}

void give_way() {
  if (random_source() % 4 == 0) to_scheduler();
}

// --- warp operations ----------------------------------------------------------------------------------------------

namespace {

// From the last lane that arrives.
void post_board(Warp& warp, const Thread& last) {
  const unsigned mask = last.mask;
  Board* board = std::find_if(warp.boards, warp.boards + 32, [](const Board& b) { return b.readers == 0; });
  for (int l = 0; l < 32; ++l) {
    if (!(mask >> l & 1)) continue;
    Thread& lane = *warp.lanes[l];
    if (lane.mask != mask || lane.op != last.op)
      fail("and lane " + std::to_string(l) + " of its warp are in different warp operations");
    board->values[l] = lane.value;
    ++board->readers;
    lane.board = board;
    lane.state = State::kReady;
  }
  warp.waiting &= ~mask;
}

}  // namespace

Exchange::Exchange(unsigned mask, WarpOp op, uint64_t value) : mask_(mask), lane_(current->running->lane) {
  Thread& self = *current->running;
  Warp& warp = current->warps[self.warp];
  if (!(mask >> lane_ & 1)) fail("is not in the mask of its own warp operation");
  self.mask = mask;
  self.op = op;
  self.value = value;
  warp.waiting |= 1u << lane_;
  self.state = State::kInWarpOp;
  if ((mask & ~warp.waiting) == 0) {
    post_board(warp, self);
  } else {
    to_scheduler();
  }
  board_ = self.board;
}

Exchange::~Exchange() { --board_->readers; }

uint64_t Exchange::of(int lane) const {
  if (!(mask_ >> lane & 1)) fail("reads lane " + std::to_string(lane) + ", which is not in the mask");
  return board_->values[lane];
}

}  // namespace snh::shim
