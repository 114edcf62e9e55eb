// Samples, densities and their gradients of a Gaussian policy, as agents/policies.py defines them.
//
// Every operation is rounded as PyTorch rounds it there. Sums are taken in order, which is PyTorch's order too as long as they have
// no more than four terms; more than that is left to PyTorch.
#pragma once
#include "vector.h"

// `rows` states with `size` action dimensions: [rows, size] each, but for the network's outputs [rows, 2·size] and what belongs to
// the action space, [size].
struct Gaussian {
  int64_t rows;
  int32_t size;
  float log_std_limit;
  const float *outputs, *tanh;
  float *mean, *log_std, *std;
  const float *low, *high, *middle, *half_range;
};

// Actions [rows, n, size], or noise; `row` floats from one state's to the next one's.
struct Samples {
  const float *data;
  int64_t row;
};

// x between two ends; NaN stays NaN.
INLINE float clamped(float x, float least, float most) {
  x = x < least ? least : x;
  return x > most ? most : x;
}

// Computes mean and ln σ from the outputs and their tanh.
static void gaussian_condition(const Gaussian &policy) {
  int size = policy.size;
  for (int64_t r = 0; r < policy.rows; r++)
    for (int a = 0; a < size; a++) {
      int64_t at = r * size + a;
      policy.mean[at] = __builtin_fmaf(policy.tanh[at], policy.half_range[a], policy.middle[a]);
      policy.log_std[at] = clamped(policy.outputs[r * 2 * size + size + a], -policy.log_std_limit, policy.log_std_limit);
    }
}

// out [rows, n, size]: mean + noise·σ, clamped to the action range or not.
static void gaussian_sample(const Gaussian &policy, int64_t n, Samples noise, bool clamps, float *out) {
  constexpr float ALL = __builtin_inff();
  int size = policy.size;
  for (int64_t r = 0; r < policy.rows; r++) {
    const float *drawn = noise.data + r * noise.row;
    float *row = out + r * n * size;
    for (int a = 0; a < size; a++) {
      float mean = policy.mean[r * size + a], std = policy.std[r * size + a];
      float least = clamps ? policy.low[a] : -ALL, most = clamps ? policy.high[a] : ALL;
      for (int64_t i = 0; i < n; i++)
        row[i * size + a] = clamped(__builtin_fmaf(drawn[i * size + a], std, mean), least, most);
    }
  }
}

// out [rows, n]: ln π of actions.
static void gaussian_log_prob(const Gaussian &policy, int64_t n, Samples actions, float *out) {
  constexpr float HALF_LOG_2_PI = 0.91893853320467274178;
  int size = policy.size;
  for (int64_t r = 0; r < policy.rows; r++)
    for (int64_t i = 0; i < n; i++) {
      const float *action = actions.data + r * actions.row + i * size;
      float sum = 0;
      for (int a = 0; a < size; a++) {
        float u = (action[a] - policy.mean[r * size + a]) / policy.std[r * size + a];
        sum += (u * u * -0.5f - policy.log_std[r * size + a]) - HALF_LOG_2_PI;
      }
      out[r * n + i] = sum;
    }
}

// out [rows, 2·size]: ∂/∂outputs of Σ_i w_i ln π(a_i), for weights [rows, n], or one for all where they are null.
static void gaussian_log_prob_gradient(const Gaussian &policy, int64_t n, Samples actions, const float *weights, float weight,
                                       float *out) {
  int size = policy.size;
  for (int64_t r = 0; r < policy.rows; r++) {
    const float *of_states = actions.data + r * actions.row;
    for (int a = 0; a < size; a++) {
      int64_t at = r * size + a;
      float mean = policy.mean[at], std = policy.std[at], of_mean = 0, of_log_std = 0;
      for (int64_t i = 0; i < n; i++) {
        float w = weights ? weights[r * n + i] : weight;
        float u = (of_states[i * size + a] - mean) / std, weighted = u * w;
        of_mean += weighted;
        of_log_std += weighted * u - w;
      }
      float tanh = policy.tanh[at], half_range = policy.half_range[a], slope = half_range - tanh * tanh * half_range;
      float raw = policy.outputs[r * 2 * size + size + a];
      out[r * 2 * size + a] = of_mean / std * slope;
      out[r * 2 * size + size + a] = of_log_std * (__builtin_fabsf(raw) <= policy.log_std_limit ? 1.0f : 0.0f);
    }
  }
}
