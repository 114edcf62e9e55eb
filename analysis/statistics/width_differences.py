"""How much wider one sensitivity region is than another, and than what the step-size does, from few seeds.

With two seeds a bootstrap of seeds has three different resamples. Here every setting's mean is moved by its own standard error
times a normal number instead (a parametric bootstrap): the many settings make up for the few seeds. Intervals are basic ones,
2θ − θ*. Scores are [X, L, K, S], as in `analysis.statistics.regions`, complete, S at least 2. Luck that settings have in common
on a seed is taken for noise of each: intervals are then rather too wide.

Noise widens regions: by as much as `regions.expected_noise` says where lines do not differ, and by little where they differ
clearly; the basic interval does not take all of it away. So a difference of widths is judged twice, as it is and without the
difference of the two noise floors: the interval covers both, and a p-value is the larger of two.
"""

import numpy as np

from analysis.statistics.estimate import Estimate, need_runs
from analysis.statistics.regions import best_lines, check_region, expected_noise

RESAMPLES = 2_000
_METHOD = "basic parametric bootstrap of settings"

Tested = tuple[Estimate, float, float]
"""An estimate, the p-value of the claim that it is below 0, and that of the claim that it is above."""


def width_difference(first: np.ndarray, second: np.ndarray, *, confidence: float = 0.95, seed: int = 0) -> Tested:
    """Return the mean width of the first region less that of the second. Raises as `regions.region` does."""
    generator = np.random.default_rng(seed)
    widths, draws, floors = [], [], []
    for scores in (first, second):
        means, drawn, exists, floor = _resampled(scores, generator)
        widths.append(_width(best_lines(means, exists)))
        draws.append(_width(best_lines(drawn, exists)))
        floors.append(floor)
    num_runs = min(first.shape[-1], second.shape[-1])
    return _tested(widths[0] - widths[1], draws[0] - draws[1], [0.0, floors[0] - floors[1]], num_runs, confidence, seed)


def width_less_reach(scores: np.ndarray, *, confidence: float = 0.95, seed: int = 0) -> Tested:
    """Return the mean width less how far the mean of the lines moves along x.

    Below 0, the hyperparameter on the axis matters more than that of the lines (thesis 7.1: "the dominant factor").
    """
    means, drawn, exists, floor = _resampled(scores, np.random.default_rng(seed))

    def statistic(lines: np.ndarray) -> np.ndarray:
        return np.asarray(_width(lines) - np.ptp(lines.mean(axis=-1), axis=-1))

    draws = statistic(best_lines(drawn, exists))
    return _tested(statistic(best_lines(means, exists)), draws, [0.0, floor], scores.shape[-1], confidence, seed)


def _resampled(scores: np.ndarray, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return means [X, L, K], as many moved by their noise [resamples, X, L, K], which settings exist, and the noise floor."""
    scores, exists = check_region(scores)
    num_runs = scores.shape[-1]
    need_runs(num_runs, 2, "a width's interval")
    means = scores.mean(axis=-1)
    error = scores.std(axis=-1, ddof=1) / np.sqrt(num_runs)
    drawn = means + error * generator.standard_normal((RESAMPLES, *means.shape))
    floor = float(expected_noise(scores, exists, RESAMPLES, generator)[0].mean())
    return means, drawn, exists, floor


def _width(lines: np.ndarray) -> np.ndarray:
    return np.asarray(np.ptp(lines, axis=-1).mean(axis=-1))


def _tested(value: np.ndarray, draws: np.ndarray, shifts: list[float], num_runs: int, confidence: float, seed: int) -> Tested:
    basic = 2 * value - draws
    low, high = np.quantile(basic, [(1 - confidence) / 2, (1 + confidence) / 2])
    below, above = (
        max((int((sign * (basic - shift) >= 0).sum()) + 1) / (len(draws) + 1) for shift in shifts) for sign in (1, -1)
    )
    ends = float(low - max(shifts)), float(high - min(shifts))
    return Estimate(float(value), *ends, confidence, _METHOD, num_runs, len(draws), seed), below, above
