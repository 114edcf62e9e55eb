"""Resampling: which runs a resample consists of, in pieces that fit into memory, and the ends of an interval from resamples.

The same seed gives the same numbers. Resamples are drawn chunk by chunk from one generator, so the size of a chunk is a function
of the shape of the data alone.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.samples import Array

RESAMPLES = 10_000
_CHUNK_BYTES = 32 << 20  # of one array; a few of this size are alive at a time


def chunk_sizes(resamples: int, values_each: int) -> Iterator[int]:
    """Yield sizes that add up to `resamples`, such that `values_each` float64 for each resample stay within 32 MiB."""
    most = max(1, _CHUNK_BYTES // (8 * max(1, values_each)))
    for start in range(0, resamples, most):
        yield min(most, resamples - start)


def draw_weights(num_runs: int, resamples: int, seed: int) -> Array:
    """Return [resamples, runs]: how often each run was drawn / number of runs. The product with runs is the resampled mean."""
    rng = np.random.default_rng(seed)
    weights = np.empty((resamples, num_runs))
    start = 0
    for size in chunk_sizes(resamples, num_runs):
        drawn: NDArray[np.int64] = rng.integers(num_runs, size=(size, num_runs))
        drawn += num_runs * np.arange(size)[:, None]
        weights[start : start + size] = np.bincount(drawn.ravel(), minlength=size * num_runs).reshape(size, num_runs)
        start += size
    weights /= num_runs
    return weights


def percentile_ends(resampled: Array, confidence: float) -> tuple[Array, Array]:
    """Return the ends, each [...], of the percentile intervals of resampled statistics [..., resamples]."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(resampled, [tail, 1 - tail], axis=-1)
    return low, high
