// Threads are the caller's: a torch face passes torch's pool, a C++ program its own, a test none.
#pragma once

#include <cstdint>
#include <functional>

namespace snh {

// Calls body(begin, end) on disjoint pieces that cover [0, n), in any order, possibly at the same time.
using ParallelFor =
    std::function<void(int64_t n, const std::function<void(int64_t begin, int64_t end)>& body)>;

inline void serial_for(int64_t n, const std::function<void(int64_t, int64_t)>& body) { body(0, n); }

}  // namespace snh
