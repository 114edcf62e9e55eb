// Adam and Polyak averaging on flat parameters, as agents/optimizer.py and agents/networks.py define them.
#pragma once
#include "ahead.h"

struct Adam {
  float *first, *second;    // moments [population, n]
  const float *step_sizes;  // [population], divided by the first moment's bias correction here
  float correction_1;       // 1 − 0.9^t
  float correction_2;       // 1 / √(1 − 0.999^t)
};

constexpr float RATE_1 = 0.1f, DECAY_2 = 0.999f, EPSILON = 1e-8f;
constexpr float RATE_2 = (float)(1 - 0.999);  // 1 − 0.999f is off by 4.7e-5

struct AdamStep {
  Vector first, second, parameters;
};

INLINE AdamStep adam_step(AdamStep x, Vector g, Vector step, Vector correction_2) {
  x.first = fma(broadcast(RATE_1), g - x.first, x.first);
  x.second = fma(x.second, broadcast(DECAY_2), broadcast(RATE_2) * (g * g));
  Vector denominator = fma((Vector)SQRT(x.second), correction_2, broadcast(EPSILON));
  x.parameters = fma(step, x.first / denominator, x.parameters);
  return x;
}

// One agent; meanwhile as many floats at `later` are fetched, which are read next.
INLINE void adam_agent(const Adam &adam, int64_t agent, int64_t n, float *p, const float *g, const float *later) {
  float *m = adam.first + agent * n, *v = adam.second + agent * n;
  Vector step = broadcast(-adam.step_sizes[agent] / adam.correction_1), correction_2 = broadcast(adam.correction_2);
  int64_t i = 0;
  for (; i + WIDTH <= n; i += WIDTH) {
    fetch((const char *)(later + i));
    AdamStep x = adam_step({load(m + i), load(v + i), load(p + i)}, load(g + i), step, correction_2);
    store(m + i, x.first);
    store(v + i, x.second);
    store(p + i, x.parameters);
  }
  if (i < n) {  // the same arithmetic on what is left
    float part[4][WIDTH] = {};
    size_t bytes = sizeof(float) * (n - i);
    memcpy(part[0], m + i, bytes), memcpy(part[1], v + i, bytes), memcpy(part[2], p + i, bytes), memcpy(part[3], g + i, bytes);
    AdamStep x = adam_step({load(part[0]), load(part[1]), load(part[2])}, load(part[3]), step, correction_2);
    store(part[0], x.first), store(part[1], x.second), store(part[2], x.parameters);
    memcpy(m + i, part[0], bytes), memcpy(v + i, part[1], bytes), memcpy(p + i, part[2], bytes);
  }
}

// target ← target + β·(online − target), one agent.
INLINE void polyak_agent(int64_t n, float *t, const float *p, float rate) {
  Vector weight = broadcast(rate);
  int64_t i = 0;
  for (; i + WIDTH <= n; i += WIDTH) store(t + i, fma(weight, load(p + i) - load(t + i), load(t + i)));
  for (; i < n; i++) t[i] = __builtin_fmaf(rate, p[i] - t[i], t[i]);
}

static void polyak(int population, int64_t n, float *target, const float *online, const float *weights) {
  for (int64_t a = 0; a < population; a++) polyak_agent(n, target + a * n, online + a * n, weights[a]);
}
