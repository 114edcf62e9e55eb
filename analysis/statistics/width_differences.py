"""How much wider one sensitivity region is than another, and than what the step-size does, from few seeds.

With two seeds a bootstrap of seeds has three different resamples. Here every setting's mean is moved by its own standard error
times a normal number instead (a parametric bootstrap): the many settings make up for the few seeds. Intervals are the basic ones,
2θ − θ*, as noise widens regions. Scores are [X, L, K, S], as in `analysis.statistics.regions`, complete, S at least 2. Luck that
settings have in common on a seed is taken for noise of each: intervals are then rather too wide.
"""

from collections.abc import Callable

import numpy as np

from analysis.statistics.estimate import Estimate, need_runs
from sweep.messages import UserError

RESAMPLES = 2_000
_METHOD = "basic parametric bootstrap of settings"


def width_difference(first: np.ndarray, second: np.ndarray, *, confidence: float = 0.95, seed: int = 0) -> tuple[Estimate, float]:
    """Return mean width of the first region less that of the second, and the p-value of the claim that it is below 0."""
    generator = np.random.default_rng(seed)
    value = float(_width(_means(first)) - _width(_means(second)))
    draws = _width(_drawn(first, generator)) - _width(_drawn(second, generator))
    return _estimate(value, draws, min(first.shape[-1], second.shape[-1]), confidence, seed)


def width_less_reach(scores: np.ndarray, *, confidence: float = 0.95, seed: int = 0) -> tuple[Estimate, float]:
    """Return mean width less how far the mean of the lines moves along x, and the p-value of the claim that it is below 0.

    Below 0, the hyperparameter on the axis matters more than that of the lines (thesis 7.1: "the dominant factor").
    """
    generator = np.random.default_rng(seed)

    def statistic(means: np.ndarray) -> np.ndarray:
        return np.asarray(_width(means) - np.ptp(_lines(means).mean(axis=-1), axis=-1))

    return _resampled(statistic, scores, generator, confidence, seed)


def _resampled(
    statistic: Callable[[np.ndarray], np.ndarray],
    scores: np.ndarray,
    generator: np.random.Generator,
    confidence: float,
    seed: int,
) -> tuple[Estimate, float]:
    value = float(statistic(_means(scores)))
    return _estimate(value, statistic(_drawn(scores, generator)), scores.shape[-1], confidence, seed)


def _means(scores: np.ndarray) -> np.ndarray:
    """Return the means [X, L, K], −∞ where there is no setting; UserError for a setting with some runs only."""
    need_runs(scores.shape[-1], 2, "a width's interval")
    finite = np.isfinite(scores)
    if (finite.any(axis=-1) & ~finite.all(axis=-1)).any():
        raise UserError("a width's interval needs a score of every run: launch the study again")
    return np.where(finite.all(axis=-1), np.where(finite, scores, 0).mean(axis=-1), -np.inf)


def _drawn(scores: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return means [resamples, X, L, K], each moved by its own standard error times a normal number."""
    means = _means(scores)
    finite = np.isfinite(scores)
    error = np.where(finite, scores, 0).std(axis=-1, ddof=1) / np.sqrt(scores.shape[-1])
    return means + error * generator.standard_normal((RESAMPLES, *means.shape))


def _lines(means: np.ndarray) -> np.ndarray:
    return np.asarray(means.max(axis=-1))


def _width(means: np.ndarray) -> np.ndarray:
    return np.asarray(np.ptp(_lines(means), axis=-1).mean(axis=-1))


def _estimate(value: float, draws: np.ndarray, num_runs: int, confidence: float, seed: int) -> tuple[Estimate, float]:
    low, high = np.quantile(2 * value - draws, [(1 - confidence) / 2, (1 + confidence) / 2])
    p_value = (int((2 * value - draws >= 0).sum()) + 1) / (len(draws) + 1)
    return Estimate(value, float(low), float(high), confidence, _METHOD, num_runs, len(draws), seed), p_value
