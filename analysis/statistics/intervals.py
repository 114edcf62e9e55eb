"""Intervals of the mean, or of another statistic, of independent runs.

    student         mean ± t·s/√n, t the quantile of Student's distribution with n − 1 degrees of freedom
    percentile      quantiles of the statistic of B resamples with replacement (Efron)
    bca             the same, with the quantiles corrected for bias and acceleration (Efron 1987; `scipy.stats.bootstrap`)
    standard_error  mean ± s/√n: not a 95 % interval; the confidence that it states is what it has on normal data

Under ten runs the bootstrap covers much less than it says: docs/statistics.md has measured numbers.
"""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from analysis.statistics.bootstrap import RESAMPLES, chunk_sizes
from analysis.statistics.estimate import Estimate
from analysis.statistics.samples import Array, check_count, check_name, check_share, take_runs
from sweep.messages import UserError

METHODS = {
    "student": "Student",
    "percentile": "percentile bootstrap",
    "bca": "BCa bootstrap",
    "standard_error": "±1 standard error",
}
FEW_RUNS = 10

Statistic = Callable[..., Any]


def interval(
    runs: ArrayLike,
    method: str = "student",
    confidence: float = 0.95,
    statistic: Statistic = np.mean,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """Return a statistic of the runs [n] with its interval.

    `statistic` takes an array and `axis`, like `np.mean`; methods that are not a bootstrap are for the mean alone. With
    `standard_error`, `confidence` is not asked for but stated. Runs that are all equal give an interval without width.

    Raises TooFewRunsError with fewer than two runs; UserError for an unknown method, for NaN, and where BCa is undefined.
    """
    check_name(method, METHODS, "method")
    check_share(confidence, "confidence")
    check_count(resamples, "resamples")
    sample = take_runs(runs, f"{METHODS[method]} interval")
    low, high = interval_ends(sample, method, confidence, statistic, resamples, seed)
    value = sample[0] if statistic is np.mean and _constant(sample) else statistic(sample, axis=-1)
    drawn = method in ("percentile", "bca")
    return Estimate(
        float(value),
        float(low),
        float(high),
        one_error_confidence(len(sample)) if method == "standard_error" else confidence,
        METHODS[method],
        len(sample),
        resamples if drawn else None,
        seed if drawn else None,
    )


def interval_ends(
    samples: Array,
    method: str = "student",
    confidence: float = 0.95,
    statistic: Statistic = np.mean,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> tuple[Array, Array]:
    """Return the two ends, each [...], of intervals of many samples [..., n] at once. Bootstraps give all the same resamples.

    The samples are taken as they are: finite, and of two runs at least. Raises UserError like `interval`.
    """
    if method in ("student", "standard_error"):
        if statistic is not np.mean:
            raise UserError(f'method "{method}" is for the mean; choose "percentile" or "bca" for another statistic')
        return _mean_ends(samples, method, confidence)
    flat = samples.reshape(-1, samples.shape[-1])
    low = np.array(statistic(flat, axis=-1), np.float64)
    high = low.copy()
    constant = _constant(flat)
    low[constant] = high[constant] = statistic(flat[constant, :1], axis=-1)
    varying = flat[~constant]
    if len(varying):
        low[~constant], high[~constant] = _bootstrap_ends(varying, method, confidence, statistic, resamples, seed)
    return low.reshape(samples.shape[:-1]), high.reshape(samples.shape[:-1])


def one_error_confidence(num_runs: int) -> float:
    """Return how often mean ± one standard error covers the mean of normal data: 0.58 for n = 3, 0.66 for 10, 0.68 for many."""
    return float(1 - 2 * stats.t.sf(1, num_runs - 1))


def caution(estimate: Estimate) -> str | None:
    """Return what a reader has to be told about an interval of fewer than ten runs, None otherwise."""
    if estimate.num_runs >= FEW_RUNS:
        return None
    said = f"{estimate.num_runs} runs only: "
    if "bootstrap" in estimate.method:
        return said + f"a {estimate.method} interval of so few covers less than the {estimate.confidence:.0%} it states"
    return said + "the interval is right for runs that are about normally distributed, and too short where some collapse"


def _constant(samples: Array) -> NDArray[np.bool_]:
    return np.asarray(samples.max(-1) == samples.min(-1))


def _mean_ends(samples: Array, method: str, confidence: float) -> tuple[Array, Array]:
    num_runs = samples.shape[-1]
    # the mean of equal numbers is not always that number, and their standard deviation not always 0
    constant = _constant(samples)
    mean = np.where(constant, samples[..., 0], samples.mean(-1))
    error = np.where(constant, 0, samples.std(-1, ddof=1)) / np.sqrt(num_runs)
    times = 1.0 if method == "standard_error" else stats.t.isf((1 - confidence) / 2, num_runs - 1)
    return mean - times * error, mean + times * error


def _bootstrap_ends(
    samples: Array, method: str, confidence: float, statistic: Statistic, resamples: int, seed: int
) -> tuple[Array, Array]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        warnings.simplefilter("ignore", RuntimeWarning)
        found = stats.bootstrap(
            (samples,),
            statistic,
            axis=-1,
            vectorized=True,
            n_resamples=resamples,
            batch=next(chunk_sizes(resamples, samples.size)),
            confidence_level=confidence,
            method="BCa" if method == "bca" else "percentile",
            rng=np.random.default_rng(seed),
        ).confidence_interval
    if not np.all(np.isfinite(found.low) & np.isfinite(found.high)):
        raise UserError(
            'method "bca" is undefined here: the statistic hardly changes when runs are left out; choose "percentile"'
        )
    return found.low, found.high
