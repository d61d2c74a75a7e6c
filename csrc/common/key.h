// How a vertex is found. Vertices are stored in bricks of 8 x 8; a brick is named by a one-to-one 64-bit key, so
// that no two bricks can collide (the paper's tag eta = l * sigma does: (2,3), (3,2) and (6,1) share one).
//
//   key    [62:58] level | [57:56] plane | [55:28] brick i + 2^27 | [27:0] brick j + 2^27; never negative, so -1 means
//          empty; ascending keys are ascending (level, plane, i, j)
//   local  place of a vertex in its brick, (i & 7) + 8 (j & 7); bit `local` of the brick's 64-bit mask says that the
//          vertex exists
//   slot   row of a vertex in the feature table, 64 * brick number + local; -1 = no such vertex
//
// The table is open addressing with linear probing over brick numbers: probe[h & (capacity-1)] holds a brick number
// or -1, and brick_keys[number] confirms it.
#pragma once

#include <cstdint>

#include "common/hd.h"

namespace snh {

constexpr int kBrickBits = 3;
constexpr int kBrickSide = 1 << kBrickBits;              // vertices along one side
constexpr int kBrickVertices = kBrickSide * kBrickSide;  // 64
constexpr int32_t kBrickOffset = 1 << 27;                // makes brick coordinates non-negative in a key

struct Brick {
  int level, plane;
  int32_t i, j;  // brick coordinates: vertex coordinates >> kBrickBits (arithmetic shift: floors)
};

SNH_HD inline int64_t pack_key(int level, int plane, int32_t brick_i, int32_t brick_j) {
  const uint64_t head = (static_cast<uint64_t>(level) << 2) | static_cast<uint64_t>(plane);
  const uint64_t i = static_cast<uint32_t>(brick_i + kBrickOffset),
                 j = static_cast<uint32_t>(brick_j + kBrickOffset);
  return static_cast<int64_t>((head << 56) | (i << 28) | j);
}

SNH_HD inline Brick unpack_key(int64_t key) {
  const uint64_t k = static_cast<uint64_t>(key);
  const int32_t low = (1 << 28) - 1;
  return {static_cast<int>(k >> 58), static_cast<int>((k >> 56) & 3),
          static_cast<int32_t>((k >> 28) & low) - kBrickOffset, static_cast<int32_t>(k & low) - kBrickOffset};
}

SNH_HD inline int local_of(int32_t i, int32_t j) {
  return (i & (kBrickSide - 1)) | ((j & (kBrickSide - 1)) << kBrickBits);
}

// Hash of a brick, 32-bit arithmetic only (one vector instruction per step). `head` = level * 4 + plane.
SNH_HD inline uint32_t hash_brick(uint32_t head, int32_t brick_i, int32_t brick_j) {
  uint32_t h = static_cast<uint32_t>(brick_i) * 0x9E3779B1u ^ static_cast<uint32_t>(brick_j) * 0x85EBCA77u ^
               head * 0xC2B2AE3Du;
  h ^= h >> 15;
  h *= 0x2C1B3C6Du;
  return h ^ (h >> 13);
}

// Brick number of a key whose hash_brick is `hash`, or -1. `capacity` is a power of two larger than the number of
// bricks; 0 = empty table.
SNH_HD inline int32_t find_key(int64_t key, uint32_t hash, const int32_t* probe, int64_t capacity,
                               const int64_t* brick_keys) {
  if (capacity == 0) return -1;
  for (uint32_t place = hash;; ++place) {
    const int32_t number = probe[place & static_cast<uint32_t>(capacity - 1)];
    if (number < 0 || brick_keys[number] == key) return number;
  }
}

// Brick number of a brick, or -1.
SNH_HD inline int32_t find_brick(int level, int plane, int32_t brick_i, int32_t brick_j, const int32_t* probe,
                                 int64_t capacity, const int64_t* brick_keys) {
  return find_key(pack_key(level, plane, brick_i, brick_j),
                  hash_brick(static_cast<uint32_t>(level * 4 + plane), brick_i, brick_j), probe, capacity,
                  brick_keys);
}

// Slot of a vertex, or -1.
SNH_HD inline int64_t find_slot(int level, int plane, int32_t i, int32_t j, const int32_t* probe,
                                int64_t capacity, const int64_t* brick_keys, const int64_t* masks) {
  const int32_t number =
      find_brick(level, plane, i >> kBrickBits, j >> kBrickBits, probe, capacity, brick_keys);
  if (number < 0) return -1;
  const int local = local_of(i, j);
  return (masks[number] >> local) & 1 ? static_cast<int64_t>(number) * kBrickVertices + local : -1;
}

}  // namespace snh
