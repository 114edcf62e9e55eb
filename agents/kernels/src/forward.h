// Forward passes, one agent after another, so that an agent's weights are read once a pass.
#pragma once
#include "matmul.h"
#include "network.h"

// y [batch, outputs] from the activations of the last hidden layer.
INLINE void head_forward(const Network &net, const float *p, const float *top, int batch, float *y) {
  const Layer &head = head_of(net);
  for (int i = 0; i < batch; i++)
    for (int o = 0; o < net.outputs; o++)
      y[i * net.outputs + o] = dot(top + i * head.stride, p + head.weights + o * head.stride, head.columns) + p[head.biases + o];
}

// One agent. `kept` is its hidden activations, block by block; what they hold afterwards is what the backward pass needs.
static void forward_agent(const Network &net, const float *p, const float *x, int64_t x_row, int batch, float *y, float *kept,
                          Ahead &ahead) {
  const float *below = x;
  int64_t row = x_row;
  int count = net.inputs;
  for (int l = 0; l < net.hidden; l++) {
    const Layer &layer = net.layers[l];
    layer_product<true>(below, row, batch, count, p + layer.weights, layer.stride, layer.columns, p + layer.biases, kept,
                        layer.stride, ahead);
    below = kept;
    row = layer.stride;
    count = layer.columns;
    kept += (int64_t)batch * layer.stride;
  }
  head_forward(net, p, below, batch, y);
}

// y [population, batch, outputs]. `kept` [population, activations_size] or null; then `scratch` of that size serves all agents.
static void forward(const Network &net, int population, int batch, const float *parameters, Rows x, float *y, float *kept,
                    float *scratch) {
  int64_t size = activations_size(net, batch);
  for (int a = 0; a < population; a++) {
    Ahead ahead;
    if (a + 1 < population) ahead.add(parameters + (a + 1) * net.size, net.size);
    forward_agent(net, parameters + a * net.size, x.data + a * x.agent, x.row, batch, y + (int64_t)a * batch * net.outputs,
                  kept ? kept + a * size : scratch, ahead);
  }
}
