// The corners of a cell in the table: index arithmetic, once for host and device.
#pragma once

#include <cstdint>

#include "common/hd.h"
#include "common/key.h"

namespace snh {

// The table as kernels see it: pointers into storage that the caller holds (key.h).
struct TableView {
  const int32_t* probe;  // [capacity]
  int64_t capacity;
  const int64_t* brick_keys;  // [B]
  const int64_t* masks;       // [B]
};

constexpr int kCorners = 4;  // in the order (i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)

// Slots of the corners of cell (i, j), -1 where there is no vertex. 49 of the 64 cells of a brick have all their
// corners in it: one probe finds them.
SNH_HD inline void corner_slots(int level, int plane, int32_t i, int32_t j, const TableView& table,
                                int64_t slots[kCorners]) {
  constexpr int kLast = kBrickSide - 1;
  if ((i & kLast) == kLast || (j & kLast) == kLast) {
    for (int c = 0; c < kCorners; ++c)
      slots[c] = find_slot(level, plane, i + (c & 1), j + (c >> 1), table.probe, table.capacity,
                           table.brick_keys, table.masks);
    return;
  }
  const int32_t number = find_brick(level, plane, i >> kBrickBits, j >> kBrickBits, table.probe,
                                    table.capacity, table.brick_keys);
  for (int c = 0; c < kCorners; ++c) {
    const int local = local_of(i + (c & 1), j + (c >> 1));
    const bool exists = number >= 0 && (table.masks[number] >> local & 1) != 0;
    slots[c] = exists ? static_cast<int64_t>(number) * kBrickVertices + local : -1;
  }
}

}  // namespace snh
