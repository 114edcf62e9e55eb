"""By how much the scores of one group are shifted against another's: Hodges and Lehmann's estimate with its interval.

The estimate is the median of all n₁·n₂ differences between a run of the first group and one of the second. The interval reaches
from the k-th smallest of them to the k-th largest, with the largest k for which P(U ≤ k − 1) ≤ (1 − confidence) / 2 in the
distribution of Mann and Whitney's U: it holds the shifts that the test does not reject.
"""

import math

import numpy as np
from scipy import stats

from analysis.statistics.samples import Array

_MOST_PAIRS = 2_500  # beyond, U is normal to all digits that matter


def shift_interval(first: Array, second: Array, confidence: float) -> tuple[float, float, float]:
    """Return the shift and the ends of its interval. From too few runs for the level (three and three at 95 %) it is infinite."""
    differences = np.sort(np.subtract.outer(first, second).ravel())
    tail = (1 - confidence) / 2
    rank = _exact_rank(len(first), len(second), tail)
    if rank == 0:
        return float(np.median(differences)), -math.inf, math.inf
    return float(np.median(differences)), float(differences[rank - 1]), float(differences[-rank])


def _exact_rank(num_first: int, num_second: int, tail: float) -> int:
    """Return the largest k with P(U ≤ k − 1) ≤ tail."""
    pairs = num_first * num_second
    if pairs > _MOST_PAIRS:
        spread = math.sqrt(pairs * (num_first + num_second + 1) / 12)
        return max(0, math.floor(pairs / 2 - stats.norm.isf(tail) * spread))
    below = np.cumsum(_distribution(num_first, num_second))
    return int(np.count_nonzero(below <= tail))


def _distribution(num_first: int, num_second: int) -> Array:
    """Return P(U = u), u = 0 … n₁·n₂: the coefficients of Π (1 − q^(n₂ + i)) / (1 − q^i), i = 1 … n₁, over C(n₁ + n₂, n₁)."""
    counts = np.zeros(num_first * num_second + 1)
    counts[0] = 1
    for i in range(1, num_first + 1):
        step = num_second + i
        counts[step:] -= counts[:-step].copy() if step < len(counts) else 0
        for start in range(min(i, len(counts))):
            counts[start::i] = np.cumsum(counts[start::i])
    return counts / math.comb(num_first + num_second, num_first)
