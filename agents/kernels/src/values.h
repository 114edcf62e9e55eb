// The values of many actions in each state, and the actions of highest value.
//
// The state's part of the first layer is computed once a state; rows go through the layers in groups of six; and hidden units that
// are zero in a whole group are skipped, which changes no bit of a finite result: they would add 0. The last layer is fused into
// the one before.
#pragma once
#include "forward.h"

constexpr int GROUP = TILE_ROWS, BLOCK_GROUPS = 5, BLOCK_ROWS = GROUP * BLOCK_GROUPS;  // a block stays in the L1 cache

// Positions of the set bits of every byte.
struct BitPositions {
  uint8_t at[256][8];
  constexpr BitPositions() : at{} {
    for (int byte = 0; byte < 256; byte++)
      for (int bit = 0, n = 0; bit < 8; bit++)
        if (byte >> bit & 1) at[byte][n++] = (uint8_t)bit;
  }
};
static constexpr BitPositions BITS;

// The columns of a group that are not zero in all its rows, from a word of 16 bits a line: written to `out`, which has 8 places
// to spare; returns how many.
INLINE int active_columns(const uint16_t *lines, int columns, int32_t *out) {
  int count = 0;
  for (int j = 0; j < columns; j += LINE) {
    unsigned bits = lines[j / LINE];
    UNROLL for (int half = 0; half < 2; half++) {
      unsigned byte = bits >> (8 * half) & 0xFF;
      UNROLL for (int i = 0; i < 8; i++) out[count + i] = j + 8 * half + BITS.at[byte][i];
      count += __builtin_popcount(byte);
    }
  }
  return count;
}

// Rows of hidden activations in groups of six, and which columns of each group are not zero.
struct Groups {
  float *rows;
  uint16_t *lines;  // [groups, columns / LINE]
};

// Stores C vectors of columns of a group after their ReLU, and marks those that are not zero.
template <int C>
INLINE void store_group(const Vector (&sum)[GROUP][C], float *out, int64_t row, uint16_t *lines) {
  Mask any[C] = {};
  UNROLL for (int r = 0; r < GROUP; r++)
    UNROLL for (int j = 0; j < C; j++) {
      Vector x = relu(sum[r][j]);
      store(out + r * row + WIDTH * j, x);
      any[j] |= (Mask)x;
    }
  UNROLL for (int q = 0; q < C / LINE_VECTORS; q++) lines[q] = (uint16_t)bits_of_line(any + q * LINE_VECTORS);
}

// C vectors of columns of a layer for one group: bias + Σ over its active columns.
template <int C>
INLINE void group_product(const float *a, int64_t row, const float *w, int64_t stride, const float *bias, const int32_t *columns,
                          int count, Vector (&sum)[GROUP][C], Ahead &ahead) {
  UNROLL for (int j = 0; j < C; j++) {
    Vector start = load(bias + WIDTH * j);
    UNROLL for (int r = 0; r < GROUP; r++) sum[r][j] = start;
  }
  const char *next = ahead.next();
  for (const int32_t *at = columns, *end = columns + count; at < end; at++, next += LINE_BYTES) {
    fetch(next);
    int64_t k = *at;
    const float *weights_k = w + k * stride, *a_k = a + k;
    asm("" : "+r"(weights_k));  // one pointer for all loads, not an address computed for each
    asm("" : "+r"(a_k));
    Vector weights[C];
    UNROLL for (int j = 0; j < C; j++) weights[j] = load(weights_k + WIDTH * j);
    UNROLL for (int r = 0; r < GROUP; r++) {
      Vector x = broadcast(a_k[r * row]);
      UNROLL for (int j = 0; j < C; j++) sum[r][j] = fma(x, weights[j], sum[r][j]);
    }
  }
  ahead.advance(next);
}

// One group through C vectors of columns of a hidden layer …
template <int C>
INLINE void hidden_columns(const float *a, int64_t row, const float *w, int64_t stride, const float *bias, const int32_t *columns,
                           int count, float *out, uint16_t *lines, Ahead &ahead) {
  Vector sum[GROUP][C];
  group_product<C>(a, row, w, stride, bias, columns, count, sum, ahead);
  store_group<C>(sum, out, stride, lines);
}

// … or of the last one, and on to the head: its products are added to 16 partial sums a row, in the order of the columns.
template <int C>
INLINE void last_columns(const float *a, int64_t row, const float *w, int64_t stride, const float *bias, const int32_t *columns,
                         int count, const float *head, float *parts, Ahead &ahead) {
  Vector sum[GROUP][C];
  group_product<C>(a, row, w, stride, bias, columns, count, sum, ahead);
  UNROLL for (int r = 0; r < GROUP; r++) {
    Vector part[LINE_VECTORS];
    UNROLL for (int q = 0; q < LINE_VECTORS; q++) part[q] = load(parts + r * LINE + WIDTH * q);
    UNROLL for (int j = 0; j < C; j++)
      part[j % LINE_VECTORS] = fma(relu(sum[r][j]), load(head + WIDTH * j), part[j % LINE_VECTORS]);
    UNROLL for (int q = 0; q < LINE_VECTORS; q++) store(parts + r * LINE + WIDTH * q, part[q]);
  }
}

// One group through a layer. `head` is null, or the head's weights if the layer is the last: then `out` are partial sums.
INLINE void group_layer(const float *w, int64_t stride, const float *b, int width, const float *a, int64_t row,
                        const int32_t *columns, int count, float *out, uint16_t *lines, const float *head,
                        Ahead &ahead) {
  constexpr int WIDE = TILE_VECTORS * WIDTH;
  int j = 0;
  for (; j + WIDE <= width; j += WIDE)
    if (head)
      last_columns<TILE_VECTORS>(a, row, w + j, stride, b + j, columns, count, head + j, out, ahead);
    else
      hidden_columns<TILE_VECTORS>(a, row, w + j, stride, b + j, columns, count, out + j, lines + j / LINE, ahead);
  for (; j < width; j += LINE)
    if (head)
      last_columns<LINE_VECTORS>(a, row, w + j, stride, b + j, columns, count, head + j, out, ahead);
    else
      hidden_columns<LINE_VECTORS>(a, row, w + j, stride, b + j, columns, count, out + j, lines + j / LINE, ahead);
}

// `groups` groups through a layer, with strides that are known to the compiler where they are the usual ones.
INLINE void groups_layer(const Layer &layer, const float *p, Groups below, int64_t row, int columns, int groups, int32_t *list,
                         Groups above, float *parts, const float *head, Ahead &ahead) {
  const float *w = p + layer.weights, *b = p + layer.biases;
  int lines_below = columns / LINE, lines_above = layer.columns / LINE;
  bool usual = layer.stride == 64 && layer.columns == 64 && row == 64;
  for (int g = 0; g < groups; g++) {
    const float *a = below.rows + g * GROUP * row;
    float *out = head ? parts + g * GROUP * LINE : above.rows + g * GROUP * layer.stride;
    uint16_t *lines = above.lines + g * lines_above;
    int count = active_columns(below.lines + g * lines_below, columns, list);
    if (usual)
      group_layer(w, 64, b, 64, a, 64, list, count, out, lines, head, ahead);
    else
      group_layer(w, layer.stride, b, layer.columns, a, row, list, count, out, lines, head, ahead);
  }
}

// The pairs of states and actions of one agent: pair i is state i / n with its action i % n.
struct Pairs {
  const float *states, *actions;
  int64_t states_row, actions_row, count;
  int state_size, action_size, n;
};

// Memory for a block of pairs.
struct Block {
  float *of_states;  // the states' part of the first layer
  Groups even, odd;
  float *parts;  // 16 partial sums of the output a row
  int32_t *list;
};

// Floats of scratch memory for `values`.
INLINE int64_t values_scratch(const Network &net) {
  int64_t widest = largest_stride(net);
  return BLOCK_ROWS * (3 * widest + LINE) + widest + LINE + 2 * BLOCK_GROUPS * widest / LINE;
}

INLINE Block divide(const Network &net, float *scratch) {
  int64_t widest = largest_stride(net), rows = BLOCK_ROWS * widest;
  Block block;
  block.of_states = scratch;
  block.even.rows = scratch + rows;
  block.odd.rows = scratch + 2 * rows;
  block.parts = scratch + 3 * rows;
  block.list = (int32_t *)(block.parts + BLOCK_ROWS * LINE);
  block.even.lines = (uint16_t *)(block.list + widest + LINE);
  block.odd.lines = block.even.lines + BLOCK_GROUPS * widest / LINE;
  return block;
}

// The first layer for the pairs from … to; rows that fill up the last group repeat the last pair.
INLINE void first_layer(const Network &net, const float *p, const Pairs &pairs, int64_t from, int64_t to, int groups,
                        const Block &block, Ahead &ahead) {
  const Layer &first = net.layers[0];
  int64_t stride = first.stride, first_state = from / pairs.n;
  const float *w = p + first.weights, *of_actions = w + pairs.state_size * stride;
  multiply<false>(pairs.states + first_state * pairs.states_row, pairs.states_row, 1, (int)((to - 1) / pairs.n - first_state + 1),
                  pairs.state_size, w, stride, first.columns, p + first.biases, block.of_states, stride, ahead);
  for (int g = 0; g < groups; g++) {
    const float *of_state[GROUP], *action[GROUP];
    for (int r = 0; r < GROUP; r++) {
      int64_t pair = from + g * GROUP + r < to ? from + g * GROUP + r : to - 1, state = pair / pairs.n;
      of_state[r] = block.of_states + (state - first_state) * stride;
      action[r] = pairs.actions + state * pairs.actions_row + (pair - state * pairs.n) * pairs.action_size;
    }
    for (int j = 0; j < first.columns; j += LINE) {
      Vector sum[GROUP][LINE_VECTORS];
      UNROLL for (int r = 0; r < GROUP; r++)
        UNROLL for (int q = 0; q < LINE_VECTORS; q++) sum[r][q] = load(of_state[r] + j + WIDTH * q);
      for (int k = 0; k < pairs.action_size; k++)
        UNROLL for (int q = 0; q < LINE_VECTORS; q++) {
          Vector weights = load(of_actions + k * stride + j + WIDTH * q);
          UNROLL for (int r = 0; r < GROUP; r++) sum[r][q] = fma(broadcast(action[r][k]), weights, sum[r][q]);
        }
      store_group<LINE_VECTORS>(sum, block.even.rows + g * GROUP * stride + j, stride,
                                block.even.lines + g * (first.columns / LINE) + j / LINE);
    }
  }
}

// q [count] of one agent: its first output for every pair.
static void values_agent(const Network &net, const float *p, const Pairs &pairs, float *q, const Block &block,
                         Ahead &ahead) {
  const Layer &head = head_of(net);
  const float *head_weights = p + head.weights;
  float bias = p[head.biases];
  for (int64_t from = 0; from < pairs.count; from += BLOCK_ROWS) {
    int64_t to = from + BLOCK_ROWS < pairs.count ? from + BLOCK_ROWS : pairs.count;
    int groups = (int)((to - from + GROUP - 1) / GROUP);
    first_layer(net, p, pairs, from, to, groups, block, ahead);
    if (net.hidden == 1) {
      for (int64_t i = from; i < to; i++)
        q[i] = dot(block.even.rows + (i - from) * head.stride, head_weights, head.columns) + bias;
      continue;
    }
    memset(block.parts, 0, sizeof(float) * BLOCK_ROWS * LINE);
    Groups below = block.even, above = block.odd;
    for (int l = 1; l < net.hidden; l++) {
      const Layer &under = net.layers[l - 1];
      groups_layer(net.layers[l], p, below, under.stride, under.columns, groups, block.list, above, block.parts,
                   l < net.hidden - 1 ? nullptr : head_weights, ahead);
      Groups swap = below;
      below = above;
      above = swap;
    }
    for (int64_t i = from; i < to; i++) {
      Vector parts[LINE_VECTORS];
      UNROLL for (int k = 0; k < LINE_VECTORS; k++) parts[k] = load(block.parts + (i - from) * LINE + WIDTH * k);
      q[i] = sum_of_line(parts) + bias;
    }
  }
}

// q [population, batch, n]
static void values(const Network &net, int population, int batch, int n, int state_size, const float *parameters, Rows states,
                   Rows actions, float *q, float *scratch) {
  Block block = divide(net, scratch);
  int64_t count = (int64_t)batch * n;
  for (int64_t a = 0; a < population; a++) {
    Pairs pairs = {states.data + a * states.agent, actions.data + a * actions.agent, states.row,
                   actions.row, count, state_size, net.inputs - state_size, n};
    Ahead ahead;
    if (a + 1 < population) {
      ahead.add(parameters + (a + 1) * net.size, net.size);
      ahead.add(pairs.actions + actions.agent, actions.agent);
    }
    values_agent(net, parameters + a * net.size, pairs, q + a * count, block, ahead);
  }
}

// The highest of some whole lines of numbers, none of them NaN.
INLINE float highest(const float *p, int count) {
  Vector parts[LINE_VECTORS];
  UNROLL for (int q = 0; q < LINE_VECTORS; q++) parts[q] = load(p + WIDTH * q);
  for (int j = LINE; j < count; j += LINE)
    UNROLL for (int q = 0; q < LINE_VECTORS; q++) parts[q] = (Vector)MAX(parts[q], load(p + j + WIDTH * q));
  float m[LINE];
  memcpy(m, parts, sizeof m);
  UNROLL for (int n = LINE / 2; n > 0; n /= 2)
    UNROLL for (int i = 0; i < n; i++) m[i] = m[i] > m[i + n] ? m[i] : m[i + n];
  return m[0];
}

// The place of the first number that is x, which is among them, in lines of numbers.
INLINE int first_of(float x, const float *p) {
  for (int j = 0;; j += LINE) {
    Mask same[LINE_VECTORS];
    UNROLL for (int q = 0; q < LINE_VECTORS; q++) same[q] = (Mask)(load(p + j + WIDTH * q) == broadcast(x));
    unsigned bits = bits_of_line(same);
    if (bits) return j + __builtin_ctz(bits);
  }
}

// The k actions [rows, k, size] of highest value among n [rows, n, size], best first; of equal ones the first. NaN and −∞ are
// never best: where nothing else is left, the first action is taken. `left` has room for n floats, rounded up to a line.
static void best_actions(int64_t rows, int n, int size, int k, const float *q, const float *actions, float *out, float *left) {
  constexpr float NONE = -__builtin_inff();
  int padded = (n + LINE - 1) / LINE * LINE;
  for (int i = n; i < padded; i++) left[i] = NONE;
  for (int64_t r = 0; r < rows; r++) {
    for (int i = 0; i < n; i++) left[i] = q[r * n + i] >= NONE ? q[r * n + i] : NONE;
    for (int j = 0; j < k; j++) {
      int at = first_of(highest(left, padded), left);
      left[at] = NONE;
      for (int c = 0; c < size; c++) out[(r * k + j) * size + c] = actions[(r * n + at) * size + c];
    }
  }
}
