// Vectors of W = SNH_SIMD_WIDTH floats by GCC's vector extension, and the few operations it lacks. Included once per
// instruction set, inside its own namespace, so that no symbol of one set can stand in for another's.
#pragma once

#include <cstdint>
#ifdef __SSE2__
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // of GCC 12 about its own header
#include <immintrin.h>
#pragma GCC diagnostic pop
#endif

#define SNH_INLINE inline __attribute__((always_inline))

namespace snh::SNH_SIMD {

constexpr int W = SNH_SIMD_WIDTH;

typedef float vec __attribute__((vector_size(4 * W)));
typedef int32_t veci __attribute__((vector_size(4 * W)));
typedef uint32_t vecu __attribute__((vector_size(4 * W)));
typedef float vec4 __attribute__((vector_size(16)));  // a feature row
typedef float vec8 __attribute__((vector_size(32)));  // two feature rows

typedef float vec_any __attribute__((vector_size(4 * W), aligned(4), may_alias));
typedef int32_t veci_any __attribute__((vector_size(4 * W), aligned(4), may_alias));
typedef float vec4_any __attribute__((vector_size(16), aligned(4), may_alias));
typedef float vec8_any __attribute__((vector_size(32), aligned(4), may_alias));

SNH_INLINE vec load(const float* p) { return *reinterpret_cast<const vec_any*>(p); }
SNH_INLINE void store(float* p, vec x) { *reinterpret_cast<vec_any*>(p) = x; }
SNH_INLINE veci load(const int32_t* p) { return *reinterpret_cast<const veci_any*>(p); }
SNH_INLINE void store(int32_t* p, veci x) { *reinterpret_cast<veci_any*>(p) = x; }
SNH_INLINE vec4 load4(const float* p) { return *reinterpret_cast<const vec4_any*>(p); }
SNH_INLINE void store4(float* p, vec4 x) { *reinterpret_cast<vec4_any*>(p) = x; }

SNH_INLINE vec8 load8(const float* p) { return *reinterpret_cast<const vec8_any*>(p); }
SNH_INLINE void store8(float* p, vec8 x) { *reinterpret_cast<vec8_any*>(p) = x; }

SNH_INLINE vec splat(float x) { return x - vec{}; }
SNH_INLINE veci splat(int32_t x) { return x - veci{}; }

// Sum of the two halves, and the row twice.
SNH_INLINE vec4 fold(vec8 x) {
  return __builtin_shufflevector(x, x, 0, 1, 2, 3) + __builtin_shufflevector(x, x, 4, 5, 6, 7);
}
SNH_INLINE vec8 twice(vec4 x) { return __builtin_shufflevector(x, x, 0, 1, 2, 3, 0, 1, 2, 3); }

SNH_INLINE vec to_float(veci x) { return __builtin_convertvector(x, vec); }
SNH_INLINE veci to_int(vec x) { return __builtin_convertvector(x, veci); }  // towards zero

SNH_INLINE vec min(vec a, vec b) { return a < b ? a : b; }
SNH_INLINE vec max(vec a, vec b) { return a > b ? a : b; }
SNH_INLINE vec abs(vec a) { return reinterpret_cast<vec>(reinterpret_cast<veci>(a) & 0x7fffffff); }

#if SNH_SIMD_WIDTH == 16
#define SNH_LANES 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15
#define SNH_LANES_BEFORE 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14
#elif SNH_SIMD_WIDTH == 8
#define SNH_LANES 0, 1, 2, 3, 4, 5, 6, 7
#define SNH_LANES_BEFORE 0, 0, 1, 2, 3, 4, 5, 6
#else
#define SNH_LANES 0, 1, 2, 3
#define SNH_LANES_BEFORE 0, 0, 1, 2
#endif

SNH_INLINE veci lanes() { return veci{SNH_LANES}; }
// Lane l holds what lane l - 1 held; lane 0 keeps its own.
SNH_INLINE veci from_lane_before(veci x) { return __builtin_shuffle(x, veci{SNH_LANES_BEFORE}); }

// Bit l is set where lane l of a comparison holds.
SNH_INLINE uint32_t bits(veci mask) {
#if SNH_SIMD_WIDTH == 16 && defined(__AVX512DQ__)
  return _mm512_movepi32_mask(reinterpret_cast<__m512i>(mask));
#elif SNH_SIMD_WIDTH == 8 && defined(__AVX2__)
  return static_cast<uint32_t>(_mm256_movemask_ps(reinterpret_cast<__m256>(mask)));
#elif SNH_SIMD_WIDTH == 4 && defined(__SSE2__)
  return static_cast<uint32_t>(_mm_movemask_ps(reinterpret_cast<__m128>(mask)));
#else
  uint32_t result = 0;
  for (int l = 0; l < W; ++l) result |= static_cast<uint32_t>(mask[l] & 1) << l;
  return result;
#endif
}

SNH_INLINE veci gather(const int32_t* base, veci index) {
#if SNH_SIMD_WIDTH == 16 && defined(__AVX512F__)
  return reinterpret_cast<veci>(
      _mm512_mask_i32gather_epi32(_mm512_setzero_si512(), 0xffff, reinterpret_cast<__m512i>(index), base, 4));
#elif SNH_SIMD_WIDTH == 8 && defined(__AVX2__)
  return reinterpret_cast<veci>(_mm256_i32gather_epi32(base, reinterpret_cast<__m256i>(index), 4));
#else
  veci result;
  for (int l = 0; l < W; ++l) result[l] = base[index[l]];
  return result;
#endif
}

// out[l] = address of row slot[l] of `rows`, 4 floats each.
SNH_INLINE void store_addresses(const float** out, const float* rows, veci slot) {
#if SNH_SIMD_WIDTH == 16 && defined(__AVX512F__)
  const __m512i base = _mm512_set1_epi64(reinterpret_cast<intptr_t>(rows));
  const __m512i low = _mm512_cvtepi32_epi64(_mm512_castsi512_si256(reinterpret_cast<__m512i>(slot)));
  const __m512i high = _mm512_cvtepi32_epi64(_mm512_extracti64x4_epi64(reinterpret_cast<__m512i>(slot), 1));
  _mm512_storeu_si512(out, _mm512_add_epi64(base, _mm512_slli_epi64(low, 4)));
  _mm512_storeu_si512(out + 8, _mm512_add_epi64(base, _mm512_slli_epi64(high, 4)));
#elif SNH_SIMD_WIDTH == 8 && defined(__AVX2__)
  const __m256i base = _mm256_set1_epi64x(reinterpret_cast<intptr_t>(rows));
  const __m256i low = _mm256_cvtepi32_epi64(_mm256_castsi256_si128(reinterpret_cast<__m256i>(slot)));
  const __m256i high = _mm256_cvtepi32_epi64(_mm256_extracti128_si256(reinterpret_cast<__m256i>(slot), 1));
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(out), _mm256_add_epi64(base, _mm256_slli_epi64(low, 4)));
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(out + 4),
                      _mm256_add_epi64(base, _mm256_slli_epi64(high, 4)));
#else
  for (int l = 0; l < W; ++l) out[l] = rows + static_cast<int64_t>(slot[l]) * 4;
#endif
}

// Sum over the lanes, in a fixed order.
SNH_INLINE float sum(vec x) {
  float lane[W];
  store(lane, x);
  for (int half = W / 2; half > 0; half /= 2)
    for (int l = 0; l < half; ++l) lane[l] += lane[l + half];
  return lane[0];
}

// Lane l of the result is the sum over the lanes of x[l]: log2(W) rounds of pairwise adds.
SNH_INLINE vec sums(vec (&x)[W]) {
#if SNH_SIMD_WIDTH == 16
  for (int k = 0; k < 8; ++k) {
    const vec a = x[k], b = x[k + 8];
    x[k] = __builtin_shuffle(a, b, veci{0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23}) +
           __builtin_shuffle(a, b, veci{8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31});
  }
  for (int k = 0; k < 4; ++k) {
    const vec a = x[k], b = x[k + 4];
    x[k] = __builtin_shuffle(a, b, veci{0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27}) +
           __builtin_shuffle(a, b, veci{4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31});
  }
  for (int k = 0; k < 2; ++k) {
    const vec a = x[k], b = x[k + 2];
    x[k] = __builtin_shuffle(a, b, veci{0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29}) +
           __builtin_shuffle(a, b, veci{2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31});
  }
  const vec a = x[0], b = x[1];
  return __builtin_shuffle(a, b, veci{0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30}) +
         __builtin_shuffle(a, b, veci{1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31});
#elif SNH_SIMD_WIDTH == 8
  for (int k = 0; k < 4; ++k) {
    const vec a = x[k], b = x[k + 4];
    x[k] = __builtin_shuffle(a, b, veci{0, 1, 2, 3, 8, 9, 10, 11}) +
           __builtin_shuffle(a, b, veci{4, 5, 6, 7, 12, 13, 14, 15});
  }
  for (int k = 0; k < 2; ++k) {
    const vec a = x[k], b = x[k + 2];
    x[k] = __builtin_shuffle(a, b, veci{0, 1, 8, 9, 4, 5, 12, 13}) +
           __builtin_shuffle(a, b, veci{2, 3, 10, 11, 6, 7, 14, 15});
  }
  const vec a = x[0], b = x[1];
  return __builtin_shuffle(a, b, veci{0, 8, 2, 10, 4, 12, 6, 14}) +
         __builtin_shuffle(a, b, veci{1, 9, 3, 11, 5, 13, 7, 15});
#else
  for (int k = 0; k < 2; ++k) {
    const vec a = x[k], b = x[k + 2];
    x[k] = __builtin_shuffle(a, b, veci{0, 1, 4, 5}) + __builtin_shuffle(a, b, veci{2, 3, 6, 7});
  }
  const vec a = x[0], b = x[1];
  return __builtin_shuffle(a, b, veci{0, 4, 2, 6}) + __builtin_shuffle(a, b, veci{1, 5, 3, 7});
#endif
}

// Rows become columns.
SNH_INLINE void transpose4(vec4 (&x)[4]) {
  typedef int32_t index4 __attribute__((vector_size(16)));
  const vec4 a = __builtin_shuffle(x[0], x[1], index4{0, 4, 1, 5}),
             b = __builtin_shuffle(x[2], x[3], index4{0, 4, 1, 5});
  const vec4 c = __builtin_shuffle(x[0], x[1], index4{2, 6, 3, 7}),
             d = __builtin_shuffle(x[2], x[3], index4{2, 6, 3, 7});
  x[0] = __builtin_shuffle(a, b, index4{0, 1, 4, 5});
  x[1] = __builtin_shuffle(a, b, index4{2, 3, 6, 7});
  x[2] = __builtin_shuffle(c, d, index4{0, 1, 4, 5});
  x[3] = __builtin_shuffle(c, d, index4{2, 3, 6, 7});
}

// Nearest integer, for |x| < 2^22.
SNH_INLINE vec round(vec x) {
  const float magic = 12582912.f;  // 1.5 * 2^23: the sum has no bits left behind the point
  return (x + magic) - magic;
}

// e^x for x <= 88, relative error 1e-7; below -87 it stays at e^-87, 1e-38.
SNH_INLINE vec exp(vec x) {
  x = max(x, splat(-87.f));
  const vec n = round(x * 1.44269504f);
  const vec r = (x - n * 0.693359375f) + n * 2.12194440e-4f;  // ln 2 in two parts
  vec p = splat(0.00139411085f);
  p = p * r + 0.00837512594f;
  p = p * r + 0.0416663513f;
  p = p * r + 0.166664153f;
  p = p * r + 0.5f;
  p = p * r + 1.f;
  p = p * r + 1.f;
  return reinterpret_cast<vec>(reinterpret_cast<veci>(p) + (to_int(n) << 23));
}

// sin(pi t) and cos(pi t) for |t| <= 1/2, absolute error 1e-7.
SNH_INLINE void sincos_pi(vec t, vec& sin, vec& cos) {
  const vec q = t * t;
  vec s = splat(0.0776559114f);
  s = s * q - 0.598290384f;
  s = s * q + 2.55007744f;
  s = s * q - 5.16771030f;
  sin = (s * q + 3.14159274f) * t;
  vec c = splat(-0.0243959315f);
  c = c * q + 0.234937072f;
  c = c * q - 1.33521199f;
  c = c * q + 4.05870914f;
  c = c * q - 4.93480206f;
  cos = c * q + 1.f;
}

}  // namespace snh::SNH_SIMD
