#include "hash_table/hash_table.h"

#include <algorithm>

#include "common/key.h"
#include "common/lattice.h"

namespace snh::cpu {

namespace {

int32_t number_of(int64_t key, const int32_t* probe, int64_t capacity, const int64_t* brick_keys) {
  const Brick brick = unpack_key(key);
  return find_brick(brick.level, brick.plane, brick.i, brick.j, probe, capacity, brick_keys);
}

// Writes the number of a brick that is not in the table into the first free place of its probe sequence.
void place_brick(int64_t key, int32_t number, int32_t* probe, int64_t capacity) {
  const Brick brick = unpack_key(key);
  const uint32_t last = static_cast<uint32_t>(capacity - 1);
  uint32_t place = hash_brick(static_cast<uint32_t>(brick.level * 4 + brick.plane), brick.i, brick.j) & last;
  while (probe[place] >= 0) place = (place + 1) & last;
  probe[place] = number;
}

bool in_key_range(const int64_t* vertex) {
  constexpr int64_t kLimit = static_cast<int64_t>(kBrickOffset) * kBrickSide;
  const auto inside = [](int64_t x) { return -kLimit <= x && x < kLimit; };
  return 0 <= vertex[0] && vertex[0] < kMaxLevels && 0 <= vertex[1] && vertex[1] < kPlanes &&
         inside(vertex[2]) && inside(vertex[3]);
}

}  // namespace

int64_t hash_table_build(const int64_t* brick_keys, int64_t n_bricks, int32_t* probe, int64_t capacity) {
  std::fill_n(probe, capacity, -1);
  for (int64_t number = 0; number < n_bricks; ++number) {
    if (number_of(brick_keys[number], probe, capacity, brick_keys) >= 0) return number;
    place_brick(brick_keys[number], static_cast<int32_t>(number), probe, capacity);
  }
  return n_bricks;
}

void hash_table_numbers(const int64_t* keys, int64_t n_keys, const int32_t* probe, int64_t capacity,
                        const int64_t* brick_keys, int32_t* numbers) {
  for (int64_t m = 0; m < n_keys; ++m) numbers[m] = number_of(keys[m], probe, capacity, brick_keys);
}

KeyCheck hash_table_check(const int64_t* keys, int64_t n_keys, const int32_t* probe, int64_t capacity,
                          const int64_t* brick_keys) {
  KeyCheck check{n_keys, 0};
  for (int64_t m = 0; m < n_keys; ++m) {
    if (keys[m] <= (m ? keys[m - 1] : -1)) return {m, 0};
    check.n_missing += number_of(keys[m], probe, capacity, brick_keys) < 0;
  }
  return check;
}

int64_t hash_table_insert(const int64_t* keys, const int64_t* new_masks, int64_t n_keys, int64_t n_bricks,
                          int32_t* probe, int64_t capacity, int64_t* brick_keys, int64_t* masks) {
  int64_t next = n_bricks;
  for (int64_t m = 0; m < n_keys; ++m) {
    int64_t number = number_of(keys[m], probe, capacity, brick_keys);
    if (number < 0) {
      number = next++;
      brick_keys[number] = keys[m];
      masks[number] = 0;
      place_brick(keys[m], static_cast<int32_t>(number), probe, capacity);
    }
    masks[number] |= new_masks[m];
  }
  return next - n_bricks;
}

void hash_table_find(const int64_t* vertices, int64_t n_vertices, const int32_t* probe, int64_t capacity,
                     const int64_t* brick_keys, const int64_t* masks, int64_t* slots) {
  for (int64_t n = 0; n < n_vertices; ++n) {
    const int64_t* v = vertices + 4 * n;  // level, plane, i, j
    slots[n] = in_key_range(v)
                   ? find_slot(static_cast<int>(v[0]), static_cast<int>(v[1]), static_cast<int32_t>(v[2]),
                               static_cast<int32_t>(v[3]), probe, capacity, brick_keys, masks)
                   : -1;
  }
}

}  // namespace snh::cpu
