// Vectors of floats for one instruction set: the only lines that depend on it.
//
// This file is compiled once for each variant (setup.py), with the flags of its instruction set. Everything is written so that
// all variants give the same bits: fused multiply-adds are explicit (-ffp-contract=off), and sums over a row have 16 partial
// sums in a fixed order whatever the width of a vector.
#pragma once
#include <stdint.h>
#include <string.h>

#if defined(__AVX512F__)
#include <immintrin.h>
#define VECTOR_WIDTH 16
#define FMA(a, b, c) _mm512_fmadd_ps(a, b, c)
#define SQRT(a) _mm512_sqrt_ps(a)
#define MAX(a, b) _mm512_max_ps(a, b)
#elif defined(__AVX2__) && defined(__FMA__)
#include <immintrin.h>
#define VECTOR_WIDTH 8
#define FMA(a, b, c) _mm256_fmadd_ps(a, b, c)
#define SQRT(a) _mm256_sqrt_ps(a)
#define MAX(a, b) _mm256_max_ps(a, b)
#elif defined(__aarch64__)
#include <arm_neon.h>
#define VECTOR_WIDTH 4
#define FMA(a, b, c) vfmaq_f32(c, a, b)
#define SQRT(a) vsqrtq_f32(a)
#define MAX(a, b) vmaxq_f32(a, b)
#else
#error "this instruction set has no fused multiply-add: the pure-torch engine is used"
#endif

#define INLINE static inline __attribute__((always_inline))
#if defined(__clang__)
#define UNROLL _Pragma("clang loop unroll(full)")
#define SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define UNROLL _Pragma("GCC unroll 16")
#define SHUFFLE(a, b, ...) __builtin_shuffle(a, b, (Int8){__VA_ARGS__})
#endif

constexpr int WIDTH = VECTOR_WIDTH;
constexpr int LINE = 16;                   // floats in a cache line: rows are padded to it, and sums have as many parts
constexpr int LINE_VECTORS = LINE / WIDTH;

typedef float Vector __attribute__((vector_size(4 * VECTOR_WIDTH)));
typedef int32_t Mask __attribute__((vector_size(4 * VECTOR_WIDTH)));
typedef float Unaligned __attribute__((vector_size(4 * VECTOR_WIDTH), aligned(4), may_alias));
typedef float Float8 __attribute__((vector_size(32)));
typedef float Float8Unaligned __attribute__((vector_size(32), aligned(4), may_alias));
typedef int32_t Int8 __attribute__((vector_size(32)));

INLINE Vector load(const float *p) { return *(const Unaligned *)p; }
INLINE void store(float *p, Vector v) { *(Unaligned *)p = v; }
INLINE Vector broadcast(float x) { return x - (Vector){}; }
INLINE Vector fma(Vector a, Vector b, Vector c) { return (Vector)FMA(a, b, c); }

// NaN stays NaN: an agent that diverges must show it.
INLINE Vector relu(Vector x) {
  Vector zero = {};
  return (Vector)MAX(zero, x);
}

// The elements of d where x > 0, else 0.
INLINE Vector where_positive(Vector x, Vector d) {
  Vector zero = {};
  return (Vector)((Mask)d & (Mask)(x > zero));
}

// Sum of 16 partial sums in a fixed order.
INLINE float sum_of_line(const Vector *parts) {
  float s[LINE];
  memcpy(s, parts, sizeof s);
  UNROLL for (int n = LINE / 2; n > 0; n /= 2)
    UNROLL for (int i = 0; i < n; i++) s[i] += s[i + n];
  return s[0];
}

// Σ a_i·b_i over whole lines.
INLINE float dot(const float *a, const float *b, int count) {
  Vector parts[LINE_VECTORS] = {};
  for (int j = 0; j < count; j += LINE)
    UNROLL for (int q = 0; q < LINE_VECTORS; q++)
      parts[q] = fma(load(a + j + WIDTH * q), load(b + j + WIDTH * q), parts[q]);
  return sum_of_line(parts);
}

// One bit for each column of a line that is set in any of its vectors of `marks`.
INLINE unsigned bits_of_line(const Mask *marks) {
  unsigned bits = 0;
  UNROLL for (int q = 0; q < LINE_VECTORS; q++) {
#if VECTOR_WIDTH == 16
    bits |= (unsigned)_mm512_test_epi32_mask((__m512i)marks[q], (__m512i)marks[q]);
#elif VECTOR_WIDTH == 8
    Mask zero = marks[q] == 0;
    bits |= (~(unsigned)_mm256_movemask_ps((__m256)zero) & 0xFFu) << (8 * q);
#else
    UNROLL for (int i = 0; i < WIDTH; i++) bits |= (unsigned)(marks[q][i] != 0) << (WIDTH * q + i);
#endif
  }
  return bits;
}
