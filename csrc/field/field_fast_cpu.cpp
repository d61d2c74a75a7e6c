#include "field/field_fast.h"

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <vector>

#include "common/key.h"
#include "field/field_simd.h"

namespace snh::fast {
namespace {

const SimdSet* find_set(const std::string& name) {
#ifdef SNH_HAVE_AVX512
  if (name == "avx512" && __builtin_cpu_supports("x86-64-v4")) return &avx512::kSimdSet;
#endif
#ifdef SNH_HAVE_AVX2
  if (name == "avx2" && __builtin_cpu_supports("x86-64-v3")) return &avx2::kSimdSet;
#endif
  return name == "baseline" ? &baseline::kSimdSet : nullptr;
}

// --- memory that is kept between calls ------------------------------------------------------------------------------

// Floats on 64-byte lines, zero when new. Grows, never shrinks.
class Buffer {
 public:
  float* floats(int64_t n) {
    if (n > size_) {
      size_ = n + n / 4;
      const size_t bytes = (static_cast<size_t>(size_) * sizeof(float) + 63) / 64 * 64;
      memory_.reset(static_cast<float*>(std::aligned_alloc(64, bytes)));
      if (!memory_) throw std::bad_alloc();
      std::memset(memory_.get(), 0, bytes);
    }
    return memory_.get();
  }

 private:
  struct Free {
    void operator()(float* p) const { std::free(p); }
  };
  std::unique_ptr<float, Free> memory_;
  int64_t size_ = 0;
};

// What one share works with. `features`, `touched`, `weight_tiles` and `T_wc` are zero between calls.
struct ShareMemory {
  Buffer workspace, features, weight_tiles, T_wc;
  std::vector<uint8_t> touched;
};

// The bricks of the hash table by place, so that W of them are found by one gather: the smallest grid around the bricks
// of each level and plane. It follows the table's keys from call to call. Where bricks lie too far apart for grids
// (kPlacesPerBrick), it stays empty and the hash table itself is asked.
class Directory {
 public:
  void point(SimdField& field) {
    if (!is_current(field)) rebuild(field);
    field.directory = entries_.empty() ? nullptr : entries_.data();
    std::copy(std::begin(grids_), std::end(grids_), field.grids);
  }

 private:
  static constexpr int64_t kPlacesPerBrick = 16, kPlacesAlways = 1 << 16;

  bool is_current(const SimdField& field) const {
    const size_t n = static_cast<size_t>(field.n_bricks);
    return keys_.size() == n && masks_.size() == n &&
           std::equal(keys_.begin(), keys_.end(), field.brick_keys) &&
           std::equal(masks_.begin(), masks_.end(), field.masks);
  }

  void rebuild(const SimdField& field) {
    keys_.assign(field.brick_keys, field.brick_keys + field.n_bricks);
    masks_.assign(field.masks, field.masks + field.n_bricks);
    entries_.clear();
    const int64_t n_places = lay_out_grids(field.n_levels);
    if (n_places > kPlacesAlways + kPlacesPerBrick * field.n_bricks) return;
    entries_.assign(static_cast<size_t>(n_places), -1);
    for (int32_t number = 0; number < field.n_bricks; ++number) {
      const Brick brick = unpack_key(keys_[number]);
      if (brick.level >= field.n_levels || brick.plane >= kPlanes) continue;
      const BrickGrid& grid = grids_[brick.level * kPlanes + brick.plane];
      entries_[grid.first + (brick.i - grid.i0) * grid.n_j + (brick.j - grid.j0)] =
          2 * number + (masks_[number] == -1);
    }
  }

  // Returns how many places all grids have.
  int64_t lay_out_grids(int n_levels) {
    Brick low[kMaxLevels * kPlanes], high[kMaxLevels * kPlanes];
    bool any[kMaxLevels * kPlanes] = {};
    for (const int64_t key : keys_) {
      const Brick brick = unpack_key(key);
      if (brick.level >= n_levels || brick.plane >= kPlanes) continue;
      const int k = brick.level * kPlanes + brick.plane;
      if (!any[k]) low[k] = high[k] = brick;
      any[k] = true;
      low[k] = {0, 0, std::min(low[k].i, brick.i), std::min(low[k].j, brick.j)};
      high[k] = {0, 0, std::max(high[k].i, brick.i), std::max(high[k].j, brick.j)};
    }
    int64_t n_places = 1;
    for (int k = 0; k < kMaxLevels * kPlanes; ++k) {
      grids_[k] = {};
      if (!any[k]) continue;
      const int64_t n_i = int64_t(high[k].i) - low[k].i + 1, n_j = int64_t(high[k].j) - low[k].j + 1;
      grids_[k] = {low[k].i, low[k].j, static_cast<int32_t>(n_i), static_cast<int32_t>(n_j),
                   static_cast<int32_t>(n_places)};
      n_places += n_i * n_j;
    }
    return n_places;
  }

  std::vector<int64_t> keys_, masks_;
  std::vector<int32_t> entries_;
  BrickGrid grids_[kMaxLevels * kPlanes] = {};
};

struct Memory {
  Buffer panels;
  Directory directory;
  std::vector<ShareMemory> shares;
};

Memory& memory_of_this_thread() {
  static thread_local Memory memory;
  return memory;
}

// --- packing --------------------------------------------------------------------------------------------------------

int64_t panel_floats(int n_rows, int n_columns) {
  return static_cast<int64_t>(round_up(n_rows, kPanel)) * n_columns;
}

// Panels [row / kPanel][column][kPanel] of a matrix whose element (r, c) is W[r * row_stride + c * column_stride].
float* pack_panels(const float* W, int n_rows, int n_columns, int row_stride, int column_stride,
                   float* panels) {
  for (int first = 0; first < n_rows; first += kPanel)
    for (int c = 0; c < n_columns; ++c)
      for (int u = 0; u < kPanel; ++u)
        *panels++ = first + u < n_rows ? W[(first + u) * row_stride + c * column_stride] : 0.f;
  return panels;
}

SimdLayer pack_layer(const float*& flat, int n_in, int n_out, float*& next) {
  SimdLayer layer{n_in, n_out, next, nullptr, nullptr};
  next = pack_panels(flat, n_out, n_in, n_in, 1, next);
  layer.backward = next;
  next = pack_panels(flat, n_in, n_out, 1, n_in, next);
  layer.bias = next;
  next = pack_panels(flat + static_cast<int64_t>(n_out) * n_in, n_out, 1, 1, 1, next);
  flat += static_cast<int64_t>(n_out) * (n_in + 1);
  return layer;
}

SimdMlp pack_mlp(const float*& flat, int n_in, int hidden, int n_out, float*& next) {
  SimdMlp mlp;
  mlp.layer[0] = pack_layer(flat, n_in, hidden, next);
  mlp.layer[1] = pack_layer(flat, hidden, hidden, next);
  mlp.layer[2] = pack_layer(flat, hidden, n_out, next);
  return mlp;
}

int64_t mlp_panel_floats(int n_in, int hidden, int n_out) {
  const auto layer = [](int a, int b) {
    return panel_floats(b, a) + panel_floats(a, b) + panel_floats(b, 1);
  };
  return layer(n_in, hidden) + layer(hidden, hidden) + layer(hidden, n_out);
}

SimdField pack(const FieldSpec& spec, const FieldModel<float>& model, Memory& memory) {
  SimdField field{};
  field.n_levels = spec.n_levels;
  field.n_features = spec.n_features;
  field.n_octaves = spec.n_octaves;
  field.n_geometry = spec.n_geometry;
  for (int l = 0; l < spec.n_levels; ++l) field.inv_cell[l] = static_cast<float>(1 / spec.cell_sizes[l]);
  field.inv_wavelength = static_cast<float>(1 / spec.base_wavelength);
  field.truncation = static_cast<float>(spec.truncation);
  field.sharpness = static_cast<float>(spec.sharpness);
  field.cut_behind = spec.cut_behind;
  field.probe = model.probe;
  field.capacity = model.capacity;
  field.brick_keys = model.brick_keys;
  field.masks = model.masks;
  field.n_bricks = model.n_bricks;
  field.features = model.features;
  memory.directory.point(field);

  const int n_color = spec.n_gamma() + spec.n_geometry;
  float* next = memory.panels.floats(mlp_panel_floats(spec.n_encoding(), spec.hidden, 1 + spec.n_geometry) +
                                     mlp_panel_floats(n_color, spec.hidden, 3));
  const float* flat = model.decoder;
  field.geometry = pack_mlp(flat, spec.n_encoding(), spec.hidden, 1 + spec.n_geometry, next);
  field.color = pack_mlp(flat, n_color, spec.hidden, 3, next);
  return field;
}

SimdRays plain(const FieldRays<float>& rays) {
  return {rays.dirs_c, rays.depth, rays.color, rays.frame_index, rays.T_wc, rays.uniforms};
}

// Calls body(share, begin, end) for n_shares static pieces of [0, n).
template <typename Body>
void for_each_share(int64_t n, int n_shares, const ParallelFor& parallel_for, const Body& body) {
  parallel_for(n_shares, [&](int64_t first, int64_t last) {
    for (int64_t k = first; k < last; ++k)
      body(static_cast<size_t>(k), n * k / n_shares, n * (k + 1) / n_shares);
  });
}

// Shares with their memory; no more of them than there is work for.
int prepare_shares(Memory& memory, const SimdSet& set, const SimdField& field, int n_samples, int64_t n,
                   int n_threads) {
  const int n_shares = static_cast<int>(std::clamp<int64_t>(n, 1, std::max(n_threads, 1)));
  if (memory.shares.size() < static_cast<size_t>(n_shares)) memory.shares.resize(n_shares);
  for (int k = 0; k < n_shares; ++k)
    memory.shares[k].workspace.floats(set.workspace_floats(field, n_samples));
  return n_shares;
}

// --- reduction of the map form's shares ---------------------------------------------------------------------------

constexpr int kBrickFloats = kBrickVertices * kFeatureStride;

void add_and_clear(float* to, float* from, int64_t n) {
  for (int64_t k = 0; k < n; ++k) {
    to[k] += from[k];
    from[k] = 0;
  }
}

// Brick b of all shares into the first, which works on the caller's tensor, in ascending order; rows of absent vertices
// are dropped.
void reduce_brick(std::vector<SimdMapShare>& shares, const int64_t* masks, int64_t b, uint8_t* touched) {
  float* brick = shares[0].grad_features + b * kBrickFloats;
  bool any = false;
  for (size_t k = 0; k < shares.size(); ++k) {
    uint8_t& own = shares[k].touched[b + 1];
    if (own && k > 0) add_and_clear(brick, shares[k].grad_features + b * kBrickFloats, kBrickFloats);
    any |= own != 0;
    own = 0;
  }
  if (!any) return;
  touched[b] = 1;
  for (int local = 0; masks[b] != -1 && local < kBrickVertices; ++local)
    if (!((masks[b] >> local) & 1)) std::fill_n(brick + local * kFeatureStride, kFeatureStride, 0.f);
}

void reduce(const SimdSet& set, const SimdField& field, std::vector<SimdMapShare>& shares, int64_t n_frames,
            const FieldGradients<float>& gradients, int64_t decoder_size, const ParallelFor& parallel_for) {
  for_each_share(field.n_bricks, static_cast<int>(shares.size()), parallel_for,
                 [&](size_t, int64_t begin, int64_t end) {
                   for (int64_t b = begin; b < end; ++b)
                     reduce_brick(shares, field.masks, b, gradients.touched);
                 });
  std::fill_n(gradients.decoder, decoder_size, 0.f);
  std::fill_n(gradients.T_wc, n_frames * 12, 0.f);
  for (SimdMapShare& share : shares) {
    set.add_weight_tiles(field, share.weight_tiles, gradients.decoder);
    add_and_clear(gradients.T_wc, share.grad_T_wc, n_frames * 12);
  }
}

}  // namespace

bool has_set(const std::string& name) { return find_set(name) != nullptr; }

std::string best_set() {
  for (const char* name : {"avx512", "avx2"})
    if (has_set(name)) return name;
  return "baseline";
}

void field_map(const std::string& name, const FieldSpec& spec, const FieldModel<float>& model,
               const FieldRays<float>& rays, const FieldSampling& sampling, const float lambdas[4],
               const FieldGradients<float>& gradients, float losses[4], int n_threads,
               const ParallelFor& parallel_for) {
  const SimdSet& set = *find_set(name);
  Memory& memory = memory_of_this_thread();
  const SimdField field = pack(spec, model, memory);
  SimdMap map{plain(rays),
              sampling.n_base,
              sampling.n_surface,
              static_cast<float>(sampling.near),
              static_cast<float>(sampling.far),
              field.truncation,
              {},
              gradients.features != nullptr};
  const double ray_share = rays.n_rays ? 1.0 / static_cast<double>(rays.n_rays) : 0.0;
  for (int k = 0; k < 4; ++k) map.lambdas[k] = static_cast<float>(lambdas[k] * ray_share);

  const int n_samples = sampling.n_base + sampling.n_surface;
  const int n_shares = prepare_shares(memory, set, field, n_samples, rays.n_rays, n_threads);
  std::vector<SimdMapShare> shares(n_shares);
  for (int k = 0; k < n_shares; ++k) {
    ShareMemory& own = memory.shares[k];
    shares[k].workspace = own.workspace.floats(0);
    if (!map.with_gradients) continue;
    own.touched.resize(std::max<size_t>(own.touched.size(), 1 + field.n_bricks));
    shares[k].grad_features = k ? own.features.floats(field.n_bricks * kBrickFloats) : gradients.features;
    shares[k].touched = own.touched.data();
    shares[k].grad_T_wc = own.T_wc.floats(rays.n_frames * 12);
    shares[k].weight_tiles = own.weight_tiles.floats(set.weight_tile_floats(field));
  }
  for_each_share(rays.n_rays, n_shares, parallel_for, [&](size_t k, int64_t begin, int64_t end) {
    shares[k].begin = begin;
    shares[k].end = end;
    set.map_rays(field, map, shares[k]);
  });
  if (map.with_gradients)
    reduce(set, field, shares, rays.n_frames, gradients, spec.decoder_size(), parallel_for);
  for (int k = 0; k < 4; ++k) {
    double total = 0;
    for (const SimdMapShare& share : shares) total += share.losses[k];
    losses[k] = static_cast<float>(total * ray_share);
  }
}

void field_track(const std::string& name, const FieldSpec& spec, const FieldModel<float>& model,
                 const FieldRays<float>& rays, int n_samples, float band, float* residuals, float* jacobian,
                 bool* valid, int n_threads, const ParallelFor& parallel_for) {
  const SimdSet& set = *find_set(name);
  Memory& memory = memory_of_this_thread();
  const SimdField field = pack(spec, model, memory);
  const SimdTrack track{plain(rays), n_samples, band, residuals, jacobian, valid};
  const int n_shares = prepare_shares(memory, set, field, n_samples, rays.n_rays, n_threads);
  for_each_share(rays.n_rays, n_shares, parallel_for, [&](size_t k, int64_t begin, int64_t end) {
    set.track_rays(field, track, begin, end, memory.shares[k].workspace.floats(0));
  });
}

void field_query(const std::string& name, const FieldSpec& spec, const FieldModel<float>& model,
                 const float* points, int64_t n_points, float* tsdf, float* color, bool* valid, int n_threads,
                 const ParallelFor& parallel_for) {
  const SimdSet& set = *find_set(name);
  Memory& memory = memory_of_this_thread();
  const SimdField field = pack(spec, model, memory);
  const int n_shares = prepare_shares(memory, set, field, 1, n_points, n_threads);
  for_each_share(n_points, n_shares, parallel_for, [&](size_t k, int64_t begin, int64_t end) {
    set.query_points(field, points, begin, end, tsdf, color, valid, memory.shares[k].workspace.floats(0));
  });
}

}  // namespace snh::fast
