// Counter-based random numbers, the streams of agents/rng.py: Philox4x32-10 in groups of 64 numbers, 16 counters at a time.
#pragma once
#include "vector.h"

constexpr int LANES = 16, GROUP_NUMBERS = 4 * LANES;
typedef uint32_t Words[4][LANES];

// The four words of the 16 counters (16·group + lane, step, purpose, 0), word by word.
INLINE void philox(uint64_t key, uint32_t group, uint32_t step, uint32_t purpose, Words c) {
  uint32_t key_0 = (uint32_t)key, key_1 = (uint32_t)(key >> 32);
  for (int i = 0; i < LANES; i++) c[0][i] = group * LANES + i, c[1][i] = step, c[2][i] = purpose, c[3][i] = 0;
  for (int round = 0; round < 10; round++) {
    for (int i = 0; i < LANES; i++) {
      uint64_t product_0 = (uint64_t)c[0][i] * 0xD2511F53u, product_1 = (uint64_t)c[2][i] * 0xCD9E8D57u;
      c[0][i] = (uint32_t)(product_1 >> 32) ^ c[1][i] ^ key_0;
      c[1][i] = (uint32_t)product_1;
      c[2][i] = (uint32_t)(product_0 >> 32) ^ c[3][i] ^ key_1;
      c[3][i] = (uint32_t)product_0;
    }
    key_0 += 0x9E3779B9u;
    key_1 += 0xBB67AE85u;
  }
}

// Sixteen numbers at once, whatever the width of a register: the compiler divides them.
typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));
typedef uint32_t Uints __attribute__((vector_size(4 * LANES)));

INLINE Floats floats(Ints x) { return __builtin_convertvector(x, Floats); }
INLINE Floats select(Ints mask, Floats yes, Floats no) { return (Floats)(((Ints)yes & mask) | ((Ints)no & ~mask)); }

INLINE Floats square_root(Floats x) {
  Vector parts[LANES / WIDTH];
  memcpy(parts, &x, sizeof x);
  UNROLL for (int i = 0; i < LANES / WIDTH; i++) parts[i] = (Vector)SQRT(parts[i]);
  memcpy(&x, parts, sizeof x);
  return x;
}

// On (0, 1], at most 2^24 numbers; the largest rounds to 1.
INLINE Floats open_uniform(const uint32_t *words) {
  Uints x;
  memcpy(&x, words, sizeof x);
  return (floats((Ints)(x >> 8)) + 0.5f) * (1.0f / 16777216.0f);
}

// ln x for x in (0, 1), to 1 ulp (the polynomial of Cephes' logf).
INLINE Floats natural_logarithm(Floats x) {
  Uints bits = (Uints)x;
  Floats m = (Floats)((bits & 0x7fffffu) | 0x3f000000u);
  Ints small = (Ints)(m < 0.70710678f);
  Ints exponent = (Ints)(bits >> 23) - 126 + small;
  m = m + (Floats)((Ints)m & small);
  Floats t = m - 1.0f, z = t * t, y = t * 7.0376836292e-2f - 1.1514610310e-1f;
  y = y * t + 1.1676998740e-1f;
  y = y * t - 1.2420140846e-1f;
  y = y * t + 1.4249322787e-1f;
  y = y * t - 1.6668057665e-1f;
  y = y * t + 2.0000714765e-1f;
  y = y * t - 2.4999993993e-1f;
  y = y * t + 3.3333331174e-1f;
  y = (y * t) * z;
  Floats e = floats(exponent);
  y = y + e * -2.12194440e-4f;
  y = y - z * 0.5f;
  return (t + y) + e * 0.693359375f;
}

// sin 2πu and cos 2πu for u in (0, 1): the nearest quarter turn is taken off exactly, the rest by polynomials.
INLINE void sine_and_cosine(Floats u, Floats &sine, Floats &cosine) {
  Ints quarter = __builtin_convertvector(u * 4.0f + 0.5f, Ints);
  Floats r = (u - floats(quarter) * 0.25f) * 6.283185307f, z = r * r;
  Floats s = z * -1.9515295891e-4f + 8.3321608736e-3f;
  s = s * z - 1.6666654611e-1f;
  s = s * (z * r) + r;
  Floats c = z * 2.443315711809948e-5f - 1.388731625493765e-3f;
  c = c * z + 4.166664568298827e-2f;
  c = c * (z * z) + (1.0f - z * 0.5f);
  Ints odd = -(quarter & 1);
  Uints sine_sign = ((Uints)quarter & 2u) << 30, cosine_sign = ((Uints)(quarter + 1) & 2u) << 30;
  sine = (Floats)((Uints)select(odd, c, s) ^ sine_sign);
  cosine = (Floats)((Uints)select(odd, s, c) ^ cosine_sign);
}

// 64 standard normal numbers (Box–Muller): words 0 and 2 are radii, 1 and 3 their angles.
INLINE void normal_group(const Words words, float out[4][LANES]) {
  UNROLL for (int pair = 0; pair < 2; pair++) {
    Floats radius = square_root(natural_logarithm(open_uniform(words[2 * pair])) * -2.0f), sine, cosine;
    sine_and_cosine(open_uniform(words[2 * pair + 1]), sine, cosine);
    Floats first = radius * cosine, second = radius * sine;
    memcpy(out[pair], &first, sizeof first);
    memcpy(out[pair + 2], &second, sizeof second);
  }
}

enum class Kind { uniform, normal };

// out [population, count]
template <Kind KIND>
static void draw(int population, const int64_t *seeds, uint32_t purpose, uint32_t step, int64_t count, float *out) {
  for (int a = 0; a < population; a++)
    for (int64_t i = 0; i < count; i += GROUP_NUMBERS) {
      Words words;
      philox((uint64_t)seeds[a], (uint32_t)(i / GROUP_NUMBERS), step, purpose, words);
      float numbers[4][LANES];
      if (KIND == Kind::normal) {
        normal_group(words, numbers);
      } else {
        UNROLL for (int w = 0; w < 4; w++) {
          Floats drawn = open_uniform(words[w]);
          memcpy(numbers[w], &drawn, sizeof drawn);
        }
      }
      int64_t left = count - i;
      memcpy(out + a * count + i, numbers, sizeof(float) * (left < GROUP_NUMBERS ? left : GROUP_NUMBERS));
    }
}

// out [population, count]: uniform on 0 … high − 1 (multiply-shift), plus a · offset for agent a
static void integers(int population, const int64_t *seeds, uint32_t purpose, uint32_t step, int64_t count, uint32_t high,
                     int64_t offset, int64_t *out) {
  for (int64_t a = 0; a < population; a++)
    for (int64_t i = 0; i < count; i += GROUP_NUMBERS) {
      Words words;
      philox((uint64_t)seeds[a], (uint32_t)(i / GROUP_NUMBERS), step, purpose, words);
      const uint32_t *word = words[0];
      for (int64_t k = 0; k < GROUP_NUMBERS && i + k < count; k++)
        out[a * count + i + k] = (int64_t)(((uint64_t)word[k] * high) >> 32) + a * offset;
    }
}
