"""Comparisons of two groups of runs: the difference with its interval first, its p-value second, how large it is third.

    welch               difference of means; variances may differ (Colas et al. 2019 recommend it)
    paired_t            mean of the differences of paired runs (row i of both groups is the same seed)
    paired_bootstrap    the same, by resampling pairs
    paired_permutation  the same, by swapping pairs
    permutation         difference of means, by permuting all runs; its interval is Welch's
    mann_whitney        ranks; the difference is Hodges and Lehmann's, the median of all differences between runs of both groups

Permutation tests go through all permutations where these are no more than `resamples`; otherwise p = (b + 1) / (m + 1), b of m
random ones being at least as extreme. A p-value is two-sided. Several comparisons need `analysis.statistics.corrections`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from analysis.statistics.bootstrap import RESAMPLES
from analysis.statistics.effects import EffectSizes, effect_sizes
from analysis.statistics.estimate import Estimate
from analysis.statistics.intervals import interval
from analysis.statistics.samples import Array, check_count, check_name, check_share, take_runs
from analysis.statistics.shift import shift_interval
from sweep.messages import UserError


@dataclass(frozen=True)
class Comparison:
    """Two groups of runs compared: the first less the second.

    `difference.num_runs` is the smaller number of runs. `exact`: whether the p-value is that of all permutations (or of the exact
    distribution of ranks), and not an approximation. `effects` never pair runs.
    """

    difference: Estimate
    p_value: float
    test: str
    effects: EffectSizes
    num_first: int
    num_second: int
    exact: bool = False


def compare(
    first: ArrayLike,
    second: ArrayLike,
    test: str = "welch",
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Comparison:
    """Return the comparison of two groups of runs, [n₁] and [n₂], by one of `TESTS`.

    Where nothing varies the limit of ever less variation is given: p = 1 for equal groups, and for `welch` and `paired_t` p = 0
    for different ones. Raises TooFewRunsError with fewer than two runs in a group; UserError for an unknown test, for NaN, and
    for paired tests of different numbers of runs.
    """
    check_name(test, TESTS, "test")
    check_share(confidence, "confidence")
    check_count(resamples, "resamples")
    x, y = take_runs(first, f"{test} of the first group"), take_runs(second, f"{test} of the second group")
    if test.startswith("paired") and len(x) != len(y):
        raise UserError(f"{test}: runs are paired by seed, and there are {len(x)} and {len(y)}")
    difference, p_value, exact = TESTS[test](x, y, confidence, resamples, seed)
    return Comparison(difference, p_value, test, effect_sizes(x, y), len(x), len(y), exact)


def _welch(x: Array, y: Array, confidence: float, resamples: int, seed: int) -> tuple[Estimate, float, bool]:
    fewest = min(len(x), len(y))
    if np.ptp(x) == np.ptp(y) == 0:
        gap = float(x[0] - y[0])
        return Estimate(gap, gap, gap, confidence, "Welch", fewest), float(gap == 0), False
    found = stats.ttest_ind(x, y, equal_var=False)
    low, high = found.confidence_interval(confidence)
    return Estimate(float(x.mean() - y.mean()), float(low), float(high), confidence, "Welch", fewest), float(found.pvalue), False


def _paired_t(x: Array, y: Array, confidence: float, resamples: int, seed: int) -> tuple[Estimate, float, bool]:
    difference = interval(x - y, "student", confidence)
    if np.ptp(x - y) == 0:
        return difference, float(difference.value == 0), False
    return difference, float(stats.ttest_rel(x, y).pvalue), False


def _paired_bootstrap(x: Array, y: Array, confidence: float, resamples: int, seed: int) -> tuple[Estimate, float, bool]:
    difference = interval(x - y, "percentile", confidence, resamples=resamples, seed=seed)
    means = np.random.default_rng(seed).choice(x - y, (resamples, len(x))).mean(1)
    # the level at which a percentile interval would end at 0
    beyond = min(np.count_nonzero(means <= 0), np.count_nonzero(means >= 0))
    return difference, min(1.0, 2 * (int(beyond) + 1) / (resamples + 1)), False


def _permutation(x: Array, y: Array, confidence: float, resamples: int, seed: int) -> tuple[Estimate, float, bool]:
    difference = _welch(x, y, confidence, resamples, seed)[0]
    exact = math.comb(len(x) + len(y), len(x)) <= resamples
    return difference, _permuted(x, y, "independent", resamples, seed), exact


def _paired_permutation(x: Array, y: Array, confidence: float, resamples: int, seed: int) -> tuple[Estimate, float, bool]:
    difference = _paired_t(x, y, confidence, resamples, seed)[0]
    return difference, _permuted(x, y, "samples", resamples, seed), 2 ** len(x) <= resamples


def _permuted(x: Array, y: Array, kind: str, resamples: int, seed: int) -> float:
    def gap(x: Array, y: Array, axis: int) -> Array:
        return np.asarray(x.mean(axis) - y.mean(axis))

    found = stats.permutation_test(
        (x, y),
        gap,
        permutation_type=kind,
        vectorized=True,
        n_resamples=resamples,
        batch=1_000,
        rng=np.random.default_rng(seed),
    )
    return float(found.pvalue)


def _mann_whitney(x: Array, y: Array, confidence: float, resamples: int, seed: int) -> tuple[Estimate, float, bool]:
    value, low, high = shift_interval(x, y, confidence)
    difference = Estimate(value, low, high, confidence, "Hodges–Lehmann", min(len(x), len(y)))
    pool = np.concatenate([x, y])
    if np.ptp(pool) == 0:
        return difference, 1.0, False
    # the exact distribution is that of ranks without ties
    exact = len(np.unique(pool)) == len(pool) and min(len(x), len(y)) <= 8
    return difference, float(stats.mannwhitneyu(x, y, method="exact" if exact else "asymptotic").pvalue), exact


TESTS: dict[str, Callable[[Array, Array, float, int, int], tuple[Estimate, float, bool]]] = {
    "welch": _welch,
    "paired_t": _paired_t,
    "paired_bootstrap": _paired_bootstrap,
    "paired_permutation": _paired_permutation,
    "permutation": _permutation,
    "mann_whitney": _mann_whitney,
}
