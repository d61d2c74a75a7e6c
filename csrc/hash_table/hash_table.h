// hash_table: which bricks of vertices exist, and which row of the feature table each vertex has (paper,
// section III-A, "Hierarchical Embeddings"). One table serves all planes and levels of a map. What a key, a
// brick, a mask and a slot are, and the order of probing, stands in common/key.h. Nothing here is
// differentiable.
//
//   probe       [capacity] int32   brick number or -1; capacity is a power of two above the number of bricks
//   brick_keys  [B] int64          key of each brick
//   masks       [B] int64          vertices of each brick that exist
//
// The number of a brick never changes, so rows of features, gradients and moments stay where they are.
// Growing is two separate steps of the caller: longer arrays for brick_keys and masks, and hash_table_build
// into a larger probe array.
#pragma once

#include <cstdint>

#include "common/stream.h"

namespace snh {

struct KeyCheck {
  int64_t first_wrong;  // first key that is negative or not above the one before it, n_keys if there is none
  int64_t n_missing;    // keys that are not in the table, where all ascend
};

namespace cpu {

// Fills probe [capacity] so that it finds bricks 0 .. n_bricks-1 again (rehash). Returns the number of bricks
// placed: fewer than n_bricks means that brick_keys[returned] appears twice.
int64_t hash_table_build(const int64_t* brick_keys, int64_t n_bricks, int32_t* probe, int64_t capacity);

// numbers [M] int32, output: brick number of each key [M], -1 = no such brick.
void hash_table_numbers(const int64_t* keys, int64_t n_keys, const int32_t* probe, int64_t capacity,
                        const int64_t* brick_keys, int32_t* numbers);

// What an insertion has to know of its keys first.
KeyCheck hash_table_check(const int64_t* keys, int64_t n_keys, const int32_t* probe, int64_t capacity,
                          const int64_t* brick_keys);

// Adds the vertices new_masks [M] of the bricks keys [M] (strictly ascending). Unknown bricks get the numbers
// n_bricks, n_bricks + 1, ... in ascending order of their keys, so the same sequence of calls gives the same
// numbers on every device; brick_keys and masks must have room for them and the probe array must stay at
// least half empty. Returns how many bricks were new.
int64_t hash_table_insert(const int64_t* keys, const int64_t* new_masks, int64_t n_keys, int64_t n_bricks,
                          int32_t* probe, int64_t capacity, int64_t* brick_keys, int64_t* masks);

// slots [N] int64, output: row of each vertex (level, plane, i, j) of vertices [N, 4] int64, -1 = no such
// vertex, also where a vertex lies beyond the range of keys (|i|, |j| up to 2^30, level below 16, plane below
// 3).
void hash_table_find(const int64_t* vertices, int64_t n_vertices, const int32_t* probe, int64_t capacity,
                     const int64_t* brick_keys, const int64_t* masks, int64_t* slots);

}  // namespace cpu

// On the device the probe array equals the CPU's bit for bit. A workspace is device memory, its content is lost.
namespace cuda {

// Waits for the stream.
int64_t hash_table_build(const int64_t* brick_keys, int64_t n_bricks, int32_t* probe, int64_t capacity,
                         int64_t workspace[1], Stream stream);

void hash_table_numbers(const int64_t* keys, int64_t n_keys, const int32_t* probe, int64_t capacity,
                        const int64_t* brick_keys, int32_t* numbers, Stream stream);

// Waits for the stream.
KeyCheck hash_table_check(const int64_t* keys, int64_t n_keys, const int32_t* probe, int64_t capacity,
                          const int64_t* brick_keys, int64_t workspace[2], Stream stream);

// Also gives the numbers [M] of all keys.
void hash_table_insert(const int64_t* keys, const int64_t* new_masks, int64_t n_keys, int64_t n_bricks,
                       int32_t* probe, int64_t capacity, int64_t* brick_keys, int64_t* masks,
                       int32_t* numbers, int64_t workspace[1], Stream stream);

void hash_table_find(const int64_t* vertices, int64_t n_vertices, const int32_t* probe, int64_t capacity,
                     const int64_t* brick_keys, const int64_t* masks, int64_t* slots, Stream stream);

}  // namespace cuda
}  // namespace snh
