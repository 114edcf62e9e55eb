// Backward passes, alone or with the optimizer's step, so that a gradient need not leave the cache.
#pragma once
#include "forward.h"
#include "optimizer.h"

INLINE void column_sums(const float *d, int64_t stride, int batch, int columns, float *out) {
  for (int j = 0; j < columns; j += WIDTH) {
    Vector sum = load(d + j);
    for (int i = 1; i < batch; i++) sum += load(d + i * stride + j);
    store(out + j, sum);
  }
}

INLINE void head_gradient(const Network &net, const float *top, const float *dy, int batch, float *g) {
  const Layer &head = head_of(net);
  for (int o = 0; o < net.outputs; o++) {
    float bias = 0;
    for (int i = 0; i < batch; i++) bias += dy[i * net.outputs + o];
    g[head.biases + o] = bias;
    float *weights = g + head.weights + o * head.stride;
    for (int j = 0; j < head.columns; j += LINE) {
      Vector sum[LINE_VECTORS] = {};
      for (int i = 0; i < batch; i++) {
        Vector d = broadcast(dy[i * net.outputs + o]);
        UNROLL for (int q = 0; q < LINE_VECTORS; q++)
          sum[q] = fma(d, load(top + i * head.stride + j + WIDTH * q), sum[q]);
      }
      UNROLL for (int q = 0; q < LINE_VECTORS; q++) store(weights + j + WIDTH * q, sum[q]);
    }
  }
}

// d [batch, stride]: the gradient with respect to the last hidden layer before its ReLU.
INLINE void below_head(const Network &net, const float *p, const float *top, const float *dy, int batch, float *d) {
  const Layer &head = head_of(net);
  const float *weights = p + head.weights;
  for (int i = 0; i < batch; i++)
    for (int j = 0; j < head.columns; j += LINE) {
      Vector sum[LINE_VECTORS] = {};
      for (int o = 0; o < net.outputs; o++) {
        Vector of_output = broadcast(dy[i * net.outputs + o]);
        UNROLL for (int q = 0; q < LINE_VECTORS; q++)
          sum[q] = fma(of_output, load(weights + o * head.stride + j + WIDTH * q), sum[q]);
      }
      UNROLL for (int q = 0; q < LINE_VECTORS; q++)
        store(d + i * head.stride + j + WIDTH * q, where_positive(load(top + i * head.stride + j + WIDTH * q), sum[q]));
    }
}

// Floats of scratch memory for backward_agent.
INLINE int64_t backward_scratch(const Network &net, int64_t batch) {
  int64_t widest = largest_stride(net);
  return 2 * batch * widest + widest * widest;
}

// One agent: the gradient g of its parameters and dx [batch, inputs], of which either may be null.
static void backward_agent(const Network &net, const float *p, const float *kept, const float *x, int64_t x_row, const float *dy,
                           int batch, float *g, float *dx, float *scratch, Ahead &ahead) {
  int64_t widest = largest_stride(net);
  float *d = scratch, *next = scratch + batch * widest, *transposed = scratch + 2 * batch * widest;
  const float *activations = kept + activations_size(net, batch) - (int64_t)batch * net.layers[net.hidden - 1].stride;
  if (g) head_gradient(net, activations, dy, batch, g);
  below_head(net, p, activations, dy, batch, d);
  for (int l = net.hidden - 1; l > 0; l--) {
    const Layer &layer = net.layers[l], &under = net.layers[l - 1];
    activations -= (int64_t)batch * under.stride;
    if (g) {
      outer_product(activations, under.stride, under.columns, batch, d, layer.stride, layer.columns, g + layer.weights,
                    layer.stride, ahead);
      column_sums(d, layer.stride, batch, layer.columns, g + layer.biases);
    }
    transpose(p + layer.weights, layer.stride, under.columns, layer.columns, transposed);
    layer_product<false>(d, layer.stride, batch, layer.columns, transposed, under.columns, under.columns, nullptr, next,
                         under.stride, ahead);
    for (int i = 0; i < batch; i++)
      for (int j = 0; j < under.columns; j += WIDTH) {
        float *at = next + i * under.stride + j;
        store(at, where_positive(load(activations + i * under.stride + j), load(at)));
      }
    float *swap = d;
    d = next;
    next = swap;
  }
  const Layer &first = net.layers[0];
  if (g) {
    outer_product(x, x_row, net.inputs, batch, d, first.stride, first.columns, g + first.weights, first.stride, ahead);
    column_sums(d, first.stride, batch, first.columns, g + first.biases);
  }
  if (dx)
    for (int i = 0; i < batch; i++)
      for (int k = 0; k < net.inputs; k++)
        dx[i * net.inputs + k] = dot(d + i * first.stride, p + first.weights + k * first.stride, first.columns);
}

static void backward(const Network &net, int population, int batch, const float *parameters, const float *kept, Rows x,
                     const float *dy, float *gradient, float *dx, float *scratch) {
  int64_t size = activations_size(net, batch);
  for (int a = 0; a < population; a++) {
    Ahead ahead;
    if (a + 1 < population) {
      ahead.add(kept + (a + 1) * size, size);
      ahead.add(parameters + (a + 1) * net.size, net.size);
    }
    backward_agent(net, parameters + a * net.size, kept + a * size, x.data + a * x.agent, x.row,
                   dy + (int64_t)a * batch * net.outputs, batch, gradient ? gradient + a * net.size : nullptr,
                   dx ? dx + (int64_t)a * batch * net.inputs : nullptr, scratch, ahead);
  }
}

// A backward pass and a step of Adam. `scratch` holds a gradient [size], zero where no parameter lies, before the rest.
static void descend(const Network &net, int population, int batch, float *parameters, const float *kept, Rows x, const float *dy,
                    Adam adam, float *scratch) {
  int64_t size = activations_size(net, batch);
  float *g = scratch;
  memset(g, 0, sizeof(float) * net.size);
  for (int64_t a = 0; a < population; a++) {
    float *p = parameters + a * net.size;
    Ahead ahead;
    ahead.add(adam.first + a * net.size, net.size);
    ahead.add(adam.second + a * net.size, net.size);
    bool last = a + 1 == population;
    if (!last) ahead.add(kept + (a + 1) * size, size);
    backward_agent(net, p, kept + a * size, x.data + a * x.agent, x.row, dy + a * batch * net.outputs, batch, g, nullptr,
                   scratch + net.size, ahead);
    adam_agent(adam, a, net.size, p, g, last ? p : p + net.size);
  }
}

// What follows a network's parameters by Polyak averaging: parameters [population, size], or null, and rates [population].
struct Follower {
  float *parameters;
  const float *rates;
};

// Floats of scratch memory for `descend` and `regress`: a gradient, an agent's activations, outputs and their gradient, and the
// backward pass's.
INLINE int64_t training_scratch(const Network &net, int64_t batch) {
  return net.size + activations_size(net, batch) + backward_scratch(net, batch) + 2 * batch * net.outputs;
}

// A step of Adam down the losses [population], the mean over the batch of Σ (outputs − targets)² for targets [population, batch,
// outputs], then one of the follower. All passes of an agent, one after another: its activations stay in the cache.
static void regress(const Network &net, int population, int batch, float *parameters, Rows x, const float *targets, Adam adam,
                    Follower follower, float *losses, float *scratch) {
  float *g = scratch, *kept = g + net.size, *rest = kept + activations_size(net, batch);
  float *y = rest + backward_scratch(net, batch), *dy = y + (int64_t)batch * net.outputs;
  int64_t count = (int64_t)batch * net.outputs;
  float scale = (float)(2.0 / batch);
  memset(g, 0, sizeof(float) * net.size);
  for (int64_t a = 0; a < population; a++) {
    float *p = parameters + a * net.size, *follows = follower.parameters ? follower.parameters + a * net.size : nullptr;
    const float *inputs = x.data + a * x.agent;
    Ahead ahead;
    ahead.add(adam.first + a * net.size, net.size);
    ahead.add(adam.second + a * net.size, net.size);
    ahead.add(follows, net.size);
    forward_agent(net, p, inputs, x.row, batch, y, kept, ahead);
    float sum = 0;
    for (int64_t i = 0; i < count; i++) {
      float error = y[i] - targets[a * count + i];
      sum += error * error;
      dy[i] = error * scale;
    }
    losses[a] = sum / batch;
    backward_agent(net, p, kept, inputs, x.row, dy, batch, g, nullptr, rest, ahead);
    adam_agent(adam, a, net.size, p, g, a + 1 < population ? p + net.size : p);
    if (follows) polyak_agent(net.size, follows, p, follower.rates[a]);
  }
}
