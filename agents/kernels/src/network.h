// The shape of a population network, as agents/kernels/layout.py lays it out.
#pragma once
#include "vector.h"

struct Layer {
  int64_t weights, biases;  // offsets in an agent's parameters
  int32_t rows, columns;    // padded fan-in and fan-out (the head: outputs, and the padded width below)
  int32_t stride;           // floats from one row to the next
  int32_t width;            // fan-out without padding
};

struct Network {
  const Layer *layers;  // hidden layers [fan-in][stride], then the head, transposed: [outputs][stride]
  int64_t size;         // floats of an agent
  int32_t hidden, inputs, outputs;
};

// A strided [population, batch, width] array whose last axis is dense.
struct Rows {
  const float *data;
  int64_t agent, row;
};

INLINE const Layer &head_of(const Network &net) { return net.layers[net.hidden]; }

INLINE int64_t largest_stride(const Network &net) {
  int64_t largest = 0;
  for (int l = 0; l < net.hidden; l++) largest = net.layers[l].stride > largest ? net.layers[l].stride : largest;
  return largest;
}

// Floats that an agent's hidden activations take, one block [batch, stride] a layer.
INLINE int64_t activations_size(const Network &net, int64_t batch) {
  int64_t total = 0;
  for (int l = 0; l < net.hidden; l++) total += batch * net.layers[l].stride;
  return total;
}
