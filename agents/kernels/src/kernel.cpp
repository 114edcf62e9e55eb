// One variant of the native engine: compiled once for each instruction set, with its name in VARIANT (setup.py).
#include "backward.h"
#include "gather.h"
#include "gaussian.h"
#include "random.h"
#include "values.h"

#define JOIN_(a, b) a##_##b
#define JOIN(a, b) JOIN_(a, b)
#define EXPORT(name) extern "C" __attribute__((visibility("default"))) void JOIN(name, VARIANT)

extern "C" __attribute__((visibility("default"))) int64_t JOIN(scratch_size, VARIANT)(const Network *net, int64_t batch) {
  int64_t training = training_scratch(*net, batch), many = values_scratch(*net);
  return training > many ? training : many;
}

EXPORT(forward)(const Network *net, int population, int batch, const float *parameters, const float *x, int64_t x_agent,
                int64_t x_row, float *y, float *kept, float *scratch) {
  forward(*net, population, batch, parameters, {x, x_agent, x_row}, y, kept, scratch);
}

EXPORT(backward)(const Network *net, int population, int batch, const float *parameters, const float *kept, const float *x,
                 int64_t x_agent, int64_t x_row, const float *dy, float *gradient, float *dx, float *scratch) {
  backward(*net, population, batch, parameters, kept, {x, x_agent, x_row}, dy, gradient, dx, scratch);
}

EXPORT(descend)(const Network *net, int population, int batch, float *parameters, const float *kept, const float *x,
                int64_t x_agent, int64_t x_row, const float *dy, float *first, float *second, const float *step_sizes,
                float correction_1, float correction_2, float *scratch) {
  descend(*net, population, batch, parameters, kept, {x, x_agent, x_row}, dy,
          {first, second, step_sizes, correction_1, correction_2}, scratch);
}

EXPORT(regress)(const Network *net, int population, int batch, float *parameters, const float *x, int64_t x_agent, int64_t x_row,
                const float *targets, float *first, float *second, const float *step_sizes, float correction_1,
                float correction_2, float *follower, const float *rates, float *losses, float *scratch) {
  regress(*net, population, batch, parameters, {x, x_agent, x_row}, targets,
          {first, second, step_sizes, correction_1, correction_2}, {follower, rates}, losses, scratch);
}

EXPORT(values)(const Network *net, int population, int batch, int n, int state_size, const float *parameters, const float *states,
               int64_t states_agent, int64_t states_row, const float *actions, int64_t actions_agent, int64_t actions_row,
               float *q, float *scratch) {
  values(*net, population, batch, n, state_size, parameters, {states, states_agent, states_row},
         {actions, actions_agent, actions_row}, q, scratch);
}

EXPORT(best_actions)(int64_t rows, int n, int size, int k, const float *q, const float *actions, float *out, float *scratch) {
  best_actions(rows, n, size, k, q, actions, out, scratch);
}

EXPORT(adam)(int population, int64_t n, float *parameters, const float *gradient, float *first, float *second,
             const float *step_sizes, float correction_1, float correction_2) {
  Adam adam = {first, second, step_sizes, correction_1, correction_2};
  for (int64_t a = 0; a < population; a++) {
    const float *g = gradient + a * n;
    adam_agent(adam, a, n, parameters + a * n, g, a + 1 < population ? g + n : g);
  }
}

EXPORT(polyak)(int population, int64_t n, float *target, const float *online, const float *weights) {
  polyak(population, n, target, online, weights);
}

EXPORT(uniforms)(int population, const int64_t *seeds, uint32_t purpose, uint32_t step, int64_t count, float *out) {
  draw<Kind::uniform>(population, seeds, purpose, step, count, out);
}

EXPORT(normals)(int population, const int64_t *seeds, uint32_t purpose, uint32_t step, int64_t count, float *out) {
  draw<Kind::normal>(population, seeds, purpose, step, count, out);
}

EXPORT(integers)(int population, const int64_t *seeds, uint32_t purpose, uint32_t step, int64_t count, uint32_t high,
                 int64_t offset, int64_t *out) {
  integers(population, seeds, purpose, step, count, high, offset, out);
}

EXPORT(gather)(int64_t count, int64_t width, const float *rows, const int64_t *indices, float *out) {
  gather(count, width, rows, indices, out);
}

EXPORT(gaussian_condition)(const Gaussian *policy) { gaussian_condition(*policy); }

EXPORT(gaussian_sample)(const Gaussian *policy, int64_t n, const float *noise, int64_t noise_row, int clamps, float *out) {
  gaussian_sample(*policy, n, {noise, noise_row}, clamps, out);
}

EXPORT(gaussian_log_prob)(const Gaussian *policy, int64_t n, const float *actions, int64_t actions_row, float *out) {
  gaussian_log_prob(*policy, n, {actions, actions_row}, out);
}

EXPORT(gaussian_log_prob_gradient)(const Gaussian *policy, int64_t n, const float *actions, int64_t actions_row,
                                   const float *weights, float weight, float *out) {
  gaussian_log_prob_gradient(*policy, n, {actions, actions_row}, weights, weight, out);
}
