// What will be needed next is fetched while the processor computes: a cache line with every step of a product's inner loop.
//
// Beside its weights, an agent's update reads and writes moments and activations that are not in the cache any more when its turn
// comes: without this, a third of the time of an optimizer's step is waiting for them.
#pragma once
#include "vector.h"

constexpr int LINE_BYTES = 4 * LINE;

class Ahead {
 public:
  // Fetch these floats too, after those before. A null pointer adds nothing.
  void add(const float *data, int64_t count) {
    if (!data || count <= 0 || size == MOST) return;
    regions[size++] = {(const char *)data, (const char *)(data + count)};
    if (size == 1) at = regions[0].from;
  }

  const char *next() const { return at; }

  // An inner loop has fetched up to `reached`; where everything is fetched, the first lines are fetched again, at no cost.
  void advance(const char *reached) {
    at = reached;
    if (size > 0 && reached >= regions[current].to) {
      current = current + 1 < size ? current + 1 : 0;
      at = regions[current].from;
    }
  }

 private:
  static constexpr int MOST = 6;
  struct Region {
    const char *from, *to;
  };
  Region regions[MOST];
  int size = 0, current = 0;
  const char *at = nullptr;
};

INLINE void fetch(const char *p) { __builtin_prefetch(p, 0, 2); }
