// Products of small matrices, held in registers tile by tile. An element's sum runs over k in ascending order whatever the tile.
#pragma once
#include "ahead.h"

constexpr int TILE_ROWS = 6;
constexpr int TILE_VECTORS = VECTOR_WIDTH == 8 ? 2 : 4;  // 12 or 24 accumulators: as many as the registers allow

// out[i][0 … C·WIDTH) = bias + Σ_k a[i·row + k·step] · w[k·stride …]
template <int R, int C, bool RELU>
INLINE void tile(const float *a, int64_t row, int64_t step, int count, const float *w, int64_t stride, const float *bias,
                 float *out, int64_t out_stride, Ahead &ahead) {
  Vector sum[R][C];
  UNROLL for (int j = 0; j < C; j++) {
    Vector start = bias ? load(bias + WIDTH * j) : Vector{};
    UNROLL for (int i = 0; i < R; i++) sum[i][j] = start;
  }
  const char *next = ahead.next();
  for (int k = 0; k < count; k++, next += LINE_BYTES) {
    fetch(next);
    Vector weights[C];
    UNROLL for (int j = 0; j < C; j++) weights[j] = load(w + k * stride + WIDTH * j);
    UNROLL for (int i = 0; i < R; i++) {
      Vector x = broadcast(a[i * row + k * step]);
      UNROLL for (int j = 0; j < C; j++) sum[i][j] = fma(x, weights[j], sum[i][j]);
    }
  }
  ahead.advance(next);
  UNROLL for (int i = 0; i < R; i++)
    UNROLL for (int j = 0; j < C; j++) store(out + i * out_stride + WIDTH * j, RELU ? relu(sum[i][j]) : sum[i][j]);
}

// `rows` rows in tiles of nearly equal height: a last tile of one row would wait for its own additions.
template <int C, bool RELU>
INLINE void panel(const float *a, int64_t row, int64_t step, int rows, int count, const float *w, int64_t stride,
                  const float *bias, float *out, int64_t out_stride, Ahead &ahead) {
  int tiles = (rows + TILE_ROWS - 1) / TILE_ROWS, from = 0;
  for (int t = 1; t <= tiles; t++) {
    int to = (int)((int64_t)rows * t / tiles);
    const float *top = a + from * row;
    float *result = out + from * out_stride;
    switch (to - from) {
      case 6: tile<6, C, RELU>(top, row, step, count, w, stride, bias, result, out_stride, ahead); break;
      case 5: tile<5, C, RELU>(top, row, step, count, w, stride, bias, result, out_stride, ahead); break;
      case 4: tile<4, C, RELU>(top, row, step, count, w, stride, bias, result, out_stride, ahead); break;
      case 3: tile<3, C, RELU>(top, row, step, count, w, stride, bias, result, out_stride, ahead); break;
      case 2: tile<2, C, RELU>(top, row, step, count, w, stride, bias, result, out_stride, ahead); break;
      default: tile<1, C, RELU>(top, row, step, count, w, stride, bias, result, out_stride, ahead);
    }
    from = to;
  }
}

// out [rows, columns] = bias + A·W with A[i][k] = a[i·row + k·step], W [count, columns]; columns is a multiple of LINE.
template <bool RELU>
INLINE void multiply(const float *a, int64_t row, int64_t step, int rows, int count, const float *w, int64_t stride, int columns,
                     const float *bias, float *out, int64_t out_stride, Ahead &ahead) {
  constexpr int WIDE = 64 / WIDTH;
  int j = 0;
  if (rows == 1)  // one row: many columns at once, so that additions need not wait for one another
    for (; j + 64 <= columns; j += 64)
      tile<1, WIDE, RELU>(a, row, step, count, w + j, stride, bias ? bias + j : nullptr, out + j, out_stride, ahead);
  for (; j + TILE_VECTORS * WIDTH <= columns; j += TILE_VECTORS * WIDTH)
    panel<TILE_VECTORS, RELU>(a, row, step, rows, count, w + j, stride, bias ? bias + j : nullptr, out + j, out_stride, ahead);
  for (; j < columns; j += LINE)
    panel<LINE_VECTORS, RELU>(a, row, step, rows, count, w + j, stride, bias ? bias + j : nullptr, out + j, out_stride, ahead);
}

// The usual shapes with strides that are known to the compiler.
template <bool RELU>
static void layer_product(const float *a, int64_t row, int rows, int count, const float *w, int64_t stride, int columns,
                          const float *bias, float *out, int64_t out_stride, Ahead &ahead) {
  if (stride == 64 && columns == 64 && out_stride == 64) {
    if (row == 64 && count == 64) return multiply<RELU>(a, 64, 1, rows, 64, w, 64, 64, bias, out, 64, ahead);
    return multiply<RELU>(a, row, 1, rows, count, w, 64, 64, bias, out, 64, ahead);
  }
  multiply<RELU>(a, row, 1, rows, count, w, stride, columns, bias, out, out_stride, ahead);
}

// out [units, columns] = Aᵀ·D for A [batch, units], D [batch, columns]: the gradient of a layer's weights.
static void outer_product(const float *a, int64_t row, int units, int batch, const float *d, int64_t d_stride, int columns,
                          float *out, int64_t out_stride, Ahead &ahead) {
  if (d_stride == 64 && columns == 64 && out_stride == 64) {
    if (row == 64) return multiply<false>(a, 1, 64, units, batch, d, 64, 64, nullptr, out, 64, ahead);
    return multiply<false>(a, 1, row, units, batch, d, 64, 64, nullptr, out, 64, ahead);
  }
  multiply<false>(a, 1, row, units, batch, d, d_stride, columns, nullptr, out, out_stride, ahead);
}

// out [columns, rows] = wᵀ, in blocks of 8 by 8; rows and columns are multiples of 8.
static void transpose(const float *w, int64_t stride, int rows, int columns, float *out) {
  for (int i = 0; i < rows; i += 8)
    for (int j = 0; j < columns; j += 8) {
      Float8 r[8], t[8], u[8];
      UNROLL for (int q = 0; q < 8; q++) r[q] = *(const Float8Unaligned *)(w + (i + q) * stride + j);
      UNROLL for (int q = 0; q < 4; q++) {
        t[2 * q] = SHUFFLE(r[2 * q], r[2 * q + 1], 0, 8, 1, 9, 4, 12, 5, 13);
        t[2 * q + 1] = SHUFFLE(r[2 * q], r[2 * q + 1], 2, 10, 3, 11, 6, 14, 7, 15);
      }
      UNROLL for (int q = 0; q < 2; q++) {
        u[4 * q] = SHUFFLE(t[4 * q], t[4 * q + 2], 0, 1, 8, 9, 4, 5, 12, 13);
        u[4 * q + 1] = SHUFFLE(t[4 * q], t[4 * q + 2], 2, 3, 10, 11, 6, 7, 14, 15);
        u[4 * q + 2] = SHUFFLE(t[4 * q + 1], t[4 * q + 3], 0, 1, 8, 9, 4, 5, 12, 13);
        u[4 * q + 3] = SHUFFLE(t[4 * q + 1], t[4 * q + 3], 2, 3, 10, 11, 6, 7, 14, 15);
      }
      UNROLL for (int q = 0; q < 4; q++) {
        *(Float8Unaligned *)(out + (int64_t)(j + q) * rows + i) = SHUFFLE(u[q], u[q + 4], 0, 1, 2, 3, 8, 9, 10, 11);
        *(Float8Unaligned *)(out + (int64_t)(j + q + 4) * rows + i) = SHUFFLE(u[q], u[q + 4], 4, 5, 6, 7, 12, 13, 14, 15);
      }
    }
}
