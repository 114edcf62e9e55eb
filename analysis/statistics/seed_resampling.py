"""Resampling of runs: the means of all settings at once, over seeds drawn anew with replacement.

Settings that are trained on the same seeds share their luck. `paired` draws the seeds, and every setting gets the same ones;
without it each setting draws its own runs. Arrays have the seeds last: [..., S]; settings are flattened where they do not matter.
"""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from scipy import special

from analysis.statistics.estimate import need_runs
from sweep.messages import UserError

_BLOCK = 4_000_000  # numbers in memory at once
_TIE = 1e-12  # of the largest score: sums of the same numbers in another order differ by less


def need_complete(scores: np.ndarray, what: str, axes: str) -> np.ndarray:
    """Return the scores as float64. `axes` names the dimensions, as "HS"; `what` begins the message, as "an importance".

    Raises UserError when dimensions are not those, there is no setting, or a run has no score; TooFewRunsError (UserError)
    below two seeds.
    """
    scores = np.asarray(scores, np.float64)
    if scores.ndim != len(axes) or 0 in scores.shape[:-1]:
        raise UserError(f"{what} needs scores [{', '.join(axes)}], none of them empty, and there are {list(scores.shape)}")
    need_runs(scores.shape[-1], 2, what)
    lacking = ~np.isfinite(scores).all(axis=-1)
    if lacking.any():
        raise UserError(
            f"{what} needs a score of every run: {int(lacking.sum()):,} of {lacking.size:,} settings lack some; leave these out, "
            "or launch the study again"
        )
    return scores


def resampled_means(
    scores: np.ndarray, resamples: int, generator: np.random.Generator, *, paired: bool = True
) -> Iterator[np.ndarray]:
    """Yield means [b, …] of scores [..., S] over resampled seeds, in blocks whose b sum up to `resamples`."""
    *shape, S = scores.shape
    flat = scores.reshape(-1, S)
    size = max(1, _BLOCK // (len(flat) if paired else flat.size))
    for start in range(0, resamples, size):
        count = min(size, resamples - start)
        if paired:
            means = seed_counts(S, count, generator) @ flat.T / S
        else:
            drawn = generator.integers(S, size=(count, *flat.shape))
            means = np.take_along_axis(flat[None], drawn, axis=-1).mean(axis=-1)
        yield means.reshape(count, *shape)


def seed_counts(num_seeds: int, resamples: int, generator: np.random.Generator) -> np.ndarray:
    """Return how often each resample draws each seed: float64 [resamples, S], rows that sum up to S."""
    return generator.multinomial(num_seeds, np.full(num_seeds, 1 / num_seeds), size=resamples).astype(np.float64)


def half_splits(num_seeds: int, splits: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return weights [splits, S] of random halves of the seeds, ⌊S/2⌋ to choose on and the others to score on.

    Their dot products with runs are the means of each half.
    """
    chosen = generator.random((splits, num_seeds)).argsort(axis=1) < num_seeds // 2
    return chosen / (num_seeds // 2), ~chosen / (num_seeds - num_seeds // 2)


def winners(means: np.ndarray) -> np.ndarray:
    """Return the index of the highest mean [...] of [..., H], of equally good ones the first."""
    tie = _TIE * np.abs(means).max(axis=-1, keepdims=True)
    return (means >= means.max(axis=-1, keepdims=True) - tie).argmax(axis=-1)


def percentiles(draws: np.ndarray, confidence: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends [...] of the percentile interval of draws [B, ...]."""
    low, high = np.quantile(draws, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return low, high


def noise_deviation(scores: np.ndarray, *, paired: bool = True) -> float:
    """Return the standard deviation of a run about its setting's mean, pooled over settings [H, S].

    With `paired`, without the luck that all settings have in common on a seed: (H − 1)(S − 1) degrees of freedom, and 0 for
    one setting, which shares all of it.
    """
    H, S = scores.shape
    residuals = scores - scores.mean(axis=1, keepdims=True)
    if paired:
        residuals = residuals - residuals.mean(axis=0)
    degrees = (H - 1 if paired else H) * (S - 1)
    return float(np.sqrt((residuals**2).sum() / degrees)) if degrees else 0.0


@lru_cache(maxsize=1024)
def expected_maximum(count: int) -> float:
    """Return the expected maximum of independent standard normal numbers: 0 for one, 1.163 for 5, 2.649 for 150.

    The expected range, highest − lowest, is twice as much: 2.326 for 5.
    """

    x = np.linspace(-10, 40, 20_001)  # the trapezoidal rule: exact to rounding for a smooth function that vanishes at both ends
    density = count * np.exp(-(x**2) / 2 + (count - 1) * special.log_ndtr(x)) / np.sqrt(2 * np.pi)
    return float(np.trapezoid(x * density, x))
