// The fast implementation of field.h in float32: field_simd.cpp on threads.
#pragma once

#include <string>

#include "common/parallel.h"
#include "field/field.h"

namespace snh::fast {

// The instruction sets of this build that this processor has, best last: "baseline", "avx2", "avx512".
bool has_set(const std::string& name);
std::string best_set();

// Largest table that fits 32-bit places.
constexpr int64_t kMaxBricks = int64_t(1) << 24;

// As their namesakes in field.h. `set` names the instruction set; the rays are cut into n_threads shares of equal
// size, so results repeat bit for bit at a given n_threads.
void field_map(const std::string& set, const FieldSpec& spec, const FieldModel<float>& model,
               const FieldRays<float>& rays, const FieldSampling& sampling, const float lambdas[4],
               const FieldGradients<float>& gradients, float losses[4], int n_threads,
               const ParallelFor& parallel_for);

void field_track(const std::string& set, const FieldSpec& spec, const FieldModel<float>& model,
                 const FieldRays<float>& rays, int n_samples, float band, float* residuals, float* jacobian,
                 bool* valid, int n_threads, const ParallelFor& parallel_for);

void field_query(const std::string& set, const FieldSpec& spec, const FieldModel<float>& model,
                 const float* points, int64_t n_points, float* tsdf, float* color, bool* valid, int n_threads,
                 const ParallelFor& parallel_for);

}  // namespace snh::fast
