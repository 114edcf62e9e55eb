"""The distribution of scores over settings: what a random setting gives, and the best of m random settings.

The settings are those of a grid, all of them, so that the only chance is that of the runs: bands are percentile intervals over
resampled seeds, point by point. Means over few runs spread further than the settings do, and the best of them is partly
luck: `best_of` gives a second curve without luck, where half of the seeds choose and the others score.
"""

from dataclasses import dataclass

import numpy as np
from scipy import special

from analysis.statistics.seed_resampling import half_splits, need_complete, percentiles, resampled_means
from sweep.messages import UserError


@dataclass(frozen=True)
class SettingCurve:
    """A curve with its pointwise band; arrays are of the same length.

    `x`: scores (ECDF), or how many settings are tried. `value`: from the data themselves. `low`, `high`: of level `confidence`.
    """

    x: np.ndarray
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    confidence: float
    method: str
    num_settings: int
    num_runs: int
    resamples: int
    seed: int


@dataclass(frozen=True)
class BestOf:
    """The expected best of m random settings, m = 1 … `len(curve.x)`.

    `curve`: the mean of the setting whose mean is highest among the m, in expectation; too good, as a maximum is.
    `split_half`: the same where the setting is chosen on half of the seeds and scored on the others, the mean over
    `curve.resamples` splits: what one would see on fresh seeds after tuning with ⌊n/2⌋ runs.
    """

    curve: SettingCurve
    split_half: np.ndarray
    replacement: bool


def distribution(
    scores: np.ndarray,
    thresholds: np.ndarray | None = None,
    *,
    paired: bool = True,
    confidence: float = 0.95,
    resamples: int = 1_000,
    seed: int,
) -> SettingCurve:
    """Return the share of settings [H, S] whose mean is at most each threshold (default: the distinct means, ascending).

    Raises UserError for a run without a score, TooFewRunsError below two seeds.
    """
    scores = need_complete(scores, "a distribution over settings", "HS")
    means = scores.mean(axis=1)
    x = np.unique(means) if thresholds is None else np.sort(np.asarray(thresholds, np.float64))
    generator = np.random.default_rng(seed)
    drawn = np.concatenate([_shares(block, x) for block in resampled_means(scores, resamples, generator, paired=paired)])
    return _curve(scores, x, _shares(means[None], x)[0], drawn, paired, confidence, seed)


def best_of(
    scores: np.ndarray,
    largest: int | None = None,
    *,
    replacement: bool = False,
    paired: bool = True,
    confidence: float = 0.95,
    resamples: int = 1_000,
    seed: int,
) -> BestOf:
    """Return the expected best of m settings drawn at random from [H, S], for m up to `largest` (default: all H).

    With `replacement` a setting may be drawn again, as in random search over a fine space: E = Σ_i x_(i) [(i/H)^m − ((i−1)/H)^m],
    x_(i) the i-th lowest mean; without it, the weight of x_(i) is C(i−1, m−1) / C(H, m). Raises as `distribution`, and UserError
    where `largest` is below 1 or, without replacement, above H.
    """
    scores = need_complete(scores, "an expected best of settings", "HS")
    H, S = scores.shape
    largest = H if largest is None else largest
    if largest < 1 or (largest > H and not replacement):
        raise UserError(f"largest: {largest} settings cannot be drawn; there are {H}, without replacement 1 to {H} can be")
    x = np.arange(1, largest + 1)
    weights = best_weights(H, largest, replacement=replacement)
    generator = np.random.default_rng(seed)
    blocks = resampled_means(scores, resamples, generator, paired=paired)
    drawn = np.concatenate([np.sort(block, axis=1) @ weights.T for block in blocks])
    choosing, scoring = half_splits(S, resamples, generator)
    order = np.argsort(choosing @ scores.T, axis=1, kind="stable")
    elsewhere = np.take_along_axis(scoring @ scores.T, order, axis=1)
    curve = _curve(scores, x, weights @ np.sort(scores.mean(axis=1)), drawn, paired, confidence, seed)
    return BestOf(curve, weights @ elsewhere.mean(axis=0), replacement)


def best_weights(count: int, largest: int, *, replacement: bool) -> np.ndarray:
    """Return the probability [largest, count] that the i-th lowest of `count` is the best of m drawn; rows sum up to 1."""
    rank, drawn = np.arange(1, count + 1), np.arange(1, largest + 1)[:, None]
    if replacement:
        return (rank / count) ** drawn - ((rank - 1) / count) ** drawn
    possible = rank >= drawn  # the others are drawn from those below it
    below = np.where(possible, rank - drawn, 0)
    with np.errstate(invalid="ignore"):
        logs = special.gammaln(rank) - special.gammaln(drawn) - special.gammaln(below + 1)
    every = special.gammaln(count + 1) - special.gammaln(drawn + 1) - special.gammaln(count - drawn + 1)
    return np.where(possible, np.exp(logs - every), 0.0)


def _shares(means: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Return the shares [B, thresholds] of means [B, H] that are at most each threshold."""
    ordered = np.sort(means, axis=1)
    return np.stack([np.searchsorted(row, thresholds, side="right") for row in ordered]) / means.shape[1]


def _curve(
    scores: np.ndarray, x: np.ndarray, value: np.ndarray, drawn: np.ndarray, paired: bool, confidence: float, seed: int
) -> SettingCurve:
    low, high = percentiles(drawn, confidence)
    method = f"{'paired ' if paired else ''}percentile bootstrap, pointwise"
    return SettingCurve(x, value, low, high, confidence, method, scores.shape[0], scores.shape[1], len(drawn), seed)
