#include <cstdint>
#include <cstdio>
#include <vector>

#include "common/key.h"
#include "hash_table/hash_table.h"
#include "ray_sample/ray_sample.h"

int main() {
  const float depth = 2.0f, uniforms[4] = {0.5f, 0.5f, 0.5f, 0.5f};
  float z[4];
  snh::cpu::ray_sample(&depth, uniforms, 1, 2, 2, 0.01f, 1.2f, 0.06f, z);
  std::printf("%.4f %.4f %.4f %.4f\n", z[0], z[1], z[2], z[3]);

  const int64_t capacity = 8, key = snh::pack_key(0, 1, -1, 2), mask = int64_t{1} << snh::local_of(-3, 17);
  std::vector<int32_t> probe(capacity, -1);
  int64_t brick_key = 0, brick_mask = 0;
  snh::cpu::hash_table_insert(&key, &mask, 1, 0, probe.data(), capacity, &brick_key, &brick_mask);
  const int64_t vertices[8] = {0, 1, -3, 17, 0, 1, -3, 18};
  int64_t slots[2];
  snh::cpu::hash_table_find(vertices, 2, probe.data(), capacity, &brick_key, &brick_mask, slots);
  std::printf("%lld %lld\n", static_cast<long long>(slots[0]), static_cast<long long>(slots[1]));
}
