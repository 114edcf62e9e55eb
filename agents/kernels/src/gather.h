// Rows picked from a large array, such as the transitions of a minibatch from replay buffers.
//
// A buffer is far larger than the caches, and its rows are picked at random: each would be waited for. Rows are fetched some way
// ahead of the one that is copied.
#pragma once
#include "vector.h"

constexpr int64_t ROWS_AHEAD = 24;

// out [count, width]: rows[indices[i]] of an array [rows, width]
static void gather(int64_t count, int64_t width, const float *rows, const int64_t *indices, float *out) {
  for (int64_t i = 0; i < count; i++) {
    if (i + ROWS_AHEAD < count) {
      const float *later = rows + indices[i + ROWS_AHEAD] * width;
      for (int64_t j = 0; j < width; j += LINE) __builtin_prefetch(later + j);
      __builtin_prefetch(later + width - 1);
    }
    const float *row = rows + indices[i] * width;
    for (int64_t j = 0; j < width; j++) out[i * width + j] = row[j];
  }
}
