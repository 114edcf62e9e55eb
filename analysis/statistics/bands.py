"""Bands around the mean of curves: pointwise, or simultaneous.

A pointwise band covers the true mean at any one point with its confidence, and all of them together with less. A simultaneous
band covers the whole curve: mean ± c·s/√n. Resamples (a multiplier bootstrap: deviations of whole runs times normal numbers, so
that points keep what they have in common) give z, the quantile of the largest studentized deviation on the curve. Since s is
estimated from the same n runs, c is the quantile of Student's distribution at the level that z has in the normal one: without
that step the band of ten runs covers 70 to 78 % of curves instead of 91 to 94 %.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from analysis.statistics.bootstrap import RESAMPLES, chunk_sizes, draw_weights, percentile_ends
from analysis.statistics.estimate import need_runs
from analysis.statistics.intervals import METHODS, interval_ends, one_error_confidence
from analysis.statistics.samples import Array, check_count, check_name, check_share, take

BAND_METHODS = ("student", "percentile", "standard_error")


@dataclass(frozen=True)
class Band:
    """A curve with a band: `value`, `low` and `high`, each [points]; the rest as in `Estimate`.

    `simultaneous`: whether `confidence` is that of the whole curve, and not of each point by itself.
    """

    value: Array
    low: Array
    high: Array
    confidence: float
    method: str
    num_runs: int
    simultaneous: bool = False
    resamples: int | None = None
    seed: int | None = None


def band(curves: ArrayLike, method: str = "student", confidence: float = 0.95, resamples: int = RESAMPLES, seed: int = 0) -> Band:
    """Return the mean of curves [runs, points] with a pointwise band, by one of `BAND_METHODS`.

    With `standard_error` the stated confidence is what it has on normal data. Raises TooFewRunsError with fewer than two runs,
    UserError for an unknown method and for NaN.
    """
    check_name(method, BAND_METHODS, "method")
    values = _take_curves(curves, confidence, resamples)
    num_runs = len(values)
    mean = _mean(values)
    if method != "percentile":
        low, high = interval_ends(np.ascontiguousarray(values.T), method, confidence)
        stated = one_error_confidence(num_runs) if method == "standard_error" else confidence
        return Band(mean, low, high, stated, METHODS[method], num_runs)
    weights = draw_weights(num_runs, resamples, seed)
    low, high = mean.copy(), mean.copy()
    start = 0
    for size in chunk_sizes(values.shape[1], resamples):
        points = slice(start, start + size)
        ends = percentile_ends((values[:, points] - mean[points]).T @ weights.T, confidence)
        low[points] += ends[0]
        high[points] += ends[1]
        start += size
    return Band(mean, low, high, confidence, METHODS[method], num_runs, False, resamples, seed)


def simultaneous_band(curves: ArrayLike, confidence: float = 0.95, resamples: int = RESAMPLES, seed: int = 0) -> Band:
    """Return the mean of curves [runs, points] with a band that covers all points at once. Raises like `band`."""
    values = _take_curves(curves, confidence, resamples)
    num_runs = len(values)
    mean = _mean(values)
    deviations = values - mean
    error = np.sqrt((deviations**2).sum(0) / (num_runs - 1) / num_runs)
    varying = error > 0
    # their product with normal numbers is standard normal at each point
    scaled = deviations[:, varying] / error[varying] / np.sqrt(num_runs * (num_runs - 1))
    multipliers = np.random.default_rng(seed).normal(size=(resamples, num_runs))
    largest = np.zeros(resamples)
    start = 0
    for size in chunk_sizes(scaled.shape[1], resamples):
        np.maximum(largest, np.abs(multipliers @ scaled[:, start : start + size]).max(1), out=largest)
        start += size
    # one point alone has Student's interval, whatever was drawn
    tail = min(float(stats.norm.sf(np.quantile(largest, confidence))), (1 - confidence) / 2)
    times = float(stats.t.isf(tail, num_runs - 1))
    method = "multiplier bootstrap of the largest studentized deviation"
    return Band(mean, mean - times * error, mean + times * error, confidence, method, num_runs, True, resamples, seed)


def _take_curves(curves: ArrayLike, confidence: float, resamples: int) -> Array:
    check_share(confidence, "confidence")
    check_count(resamples, "resamples")
    values = take(curves, "a band", (2,))
    need_runs(len(values), 2, "a band")
    return values


def _mean(values: Array) -> Array:
    # where all runs are equal, the rounded mean may differ from them, and the band would have a width
    return np.where(values.max(0) == values.min(0), values[0], values.mean(0))
