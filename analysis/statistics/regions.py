"""Sensitivity regions (thesis 7.1, Figure 7.1): how far a hyperparameter moves the best attainable score, and how much is noise.

At each x-value (the critic step-size) there is a line for each value of another hyperparameter (the entropy scale): the highest
mean over seeds among the settings that share both. The region lies between the lowest and the highest line. Scores are [X, L, K,
S]: x-values, lines, remaining settings, seeds; a setting that the study does not have is NaN on all seeds.

Lines of noisy means lie apart even where the hyperparameter has no effect. Hence, beside the width:

    corrected width    2 w − the mean width of resamples. It takes the bias away where lines differ clearly, and about 40 % of it
                       where they do not differ at all: compare with the noise floor
    noise floor        the expected width without an effect: lines of the pooled means of each (x, remaining setting), with normal
                       noise of the residuals' variance. 2.326 σ/√n for five lines with one remaining setting (`gaussian_floor`),
                       less for the best of several that are about as good (and then up to a tenth too high, as noise sets their
                       pooled means apart)
    p-value            the share of permutations at least as wide on average: lines exchange their runs within each seed, x-value
                       and remaining setting
    split-half lines   half of the seeds choose the remaining setting, the others score it: no luck of a maximum in the level

A narrow region says little where everything failed: `level` is to be read together with it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.statistics.estimate import Estimate, need_runs
from analysis.statistics.factors import determines, levels
from analysis.statistics.seed_resampling import expected_maximum, half_splits, percentiles, seed_counts
from sweep.messages import UserError, suggestion


@dataclass(frozen=True)
class Panel:
    """Scores [X, L, K, S] with what the axes stand for.

    `remaining_names`: the hyperparameters that are maximized over; `remaining_values` [K]: a tuple of their values each.
    """

    x: str
    over: str
    x_values: tuple[Any, ...]
    line_values: tuple[Any, ...]
    remaining_names: tuple[str, ...]
    remaining_values: tuple[tuple[Any, ...], ...]
    scores: np.ndarray


@dataclass(frozen=True)
class Region:
    """A region and what it is worth. Arrays have a number for each x-value [X], `lines` and `split_lines` are [X, L].

    `widths`: an interval for each x-value; `mean_width` of their mean; `corrected_width`: the mean again, without the bias of
    noise (it may be negative: no width that these runs can show). `noise_floor` [X], `mean_noise_floor`: see the module.
    `level`: the mean of all lines; `best`: the highest point of any.
    """

    lines: np.ndarray
    low: np.ndarray
    high: np.ndarray
    widths: tuple[Estimate, ...]
    mean_width: Estimate
    corrected_width: Estimate
    noise_floor: np.ndarray
    mean_noise_floor: float
    gaussian_floor: np.ndarray
    noise: float
    """σ: the standard deviation of a run about its setting's mean, without the luck that lines share on a seed."""
    p_value: float
    permutations: int
    split_lines: np.ndarray
    split_width: float
    """The mean width of the split-half lines: half of the seeds, so that noise widens it more."""
    level: Estimate
    best: float
    num_runs: int
    resamples: int
    seed: int


def arrange(scores: np.ndarray, hypers: Mapping[str, Sequence[Any]], x: str, over: str) -> Panel:
    """Arrange settings [H, S] with the values `hypers` [H each] by x-value, line and all that remains; NaN where there is none.

    Raises UserError when a name is unknown, both are the same, or one does not vary.
    """
    for name in (x, over):
        if name not in hypers:
            raise UserError(f'"{name}" is not swept here; {suggestion(name, hypers)}')
        if len(set(hypers[name])) < 2 and name == over:
            raise UserError(f'a region needs several values of "{name}", and there is one')
    if x == over:
        raise UserError(f'a region over "{over}" needs another hyperparameter on its axis')
    others = [
        name
        for name, values in hypers.items()
        if name not in (x, over) and not determines(hypers[x], values) and not determines(hypers[over], values)
    ]
    remaining = [tuple(hypers[name][h] for name in others) for h in range(len(scores))]
    axes = [levels(hypers[x]), levels(hypers[over]), levels(remaining)]
    arranged = np.full((*map(len, axes), scores.shape[1]), np.nan)
    for h, cell in enumerate(zip(hypers[x], hypers[over], remaining, strict=True)):
        position = tuple(values.index(value) for values, value in zip(axes, cell, strict=True))
        if np.isfinite(arranged[position]).any():
            raise UserError(
                f"several settings have {x} = {cell[0]}, {over} = {cell[1]} and the same of all other hyperparameters"
            )
        arranged[position] = scores[h]
    return Panel(x, over, tuple(axes[0]), tuple(axes[1]), tuple(others), tuple(axes[2]), arranged)


def region(
    scores: np.ndarray,
    *,
    confidence: float = 0.95,
    resamples: int = 1_000,
    permutations: int = 1_000,
    splits: int = 200,
    seed: int,
) -> Region:
    """Return the region of scores [X, L, K, S], L at least 2.

    Raises UserError where a setting has scores on some seeds only, or a line has no point at an x-value; TooFewRunsError
    below two seeds.
    """
    scores, exists = check_region(scores)
    X, S = scores.shape[0], scores.shape[-1]
    generator = np.random.default_rng(seed)
    counts = seed_counts(S, resamples, generator)
    lines = best_lines(scores.mean(axis=-1), exists)
    width = np.ptp(lines, axis=-1)
    drawn = best_lines(np.moveaxis(scores @ counts.T / S, -1, 0), exists)
    drawn_widths = np.ptp(drawn, axis=-1)
    floor, gaussian, noise = expected_noise(scores, exists, resamples, generator)
    choosing, scoring = half_splits(S, splits, generator)
    split_lines = _split_lines(scores, exists, choosing, scoring)
    wide = int((_permuted_widths(scores, exists, permutations, generator) >= width.mean() * (1 - 1e-12)).sum())

    def estimate(value: float, draws: np.ndarray) -> Estimate:
        low, high = percentiles(draws, confidence)
        return Estimate(float(value), float(low), float(high), confidence, "paired percentile bootstrap", S, resamples, seed)

    means = drawn_widths.mean(axis=1)
    mean_width = estimate(width.mean(), means)
    corrected = Estimate(
        value=float(2 * mean_width.value - means.mean()),
        low=2 * mean_width.value - mean_width.high,
        high=2 * mean_width.value - mean_width.low,
        confidence=confidence,
        method="paired basic bootstrap, bias removed",
        num_runs=S,
        resamples=resamples,
        seed=seed,
    )
    return Region(
        lines=lines,
        low=lines.min(axis=1),
        high=lines.max(axis=1),
        widths=tuple(estimate(width[x], drawn_widths[:, x]) for x in range(X)),
        mean_width=mean_width,
        corrected_width=corrected,
        noise_floor=floor,
        mean_noise_floor=float(floor.mean()),
        gaussian_floor=gaussian,
        noise=noise,
        p_value=(wide + 1) / (permutations + 1),
        permutations=permutations,
        split_lines=split_lines.mean(axis=0),
        split_width=float(np.ptp(split_lines, axis=-1).mean()),
        level=estimate(lines.mean(), drawn.mean(axis=(1, 2))),
        best=float(lines.max()),
        num_runs=S,
        resamples=resamples,
        seed=seed,
    )


def check_region(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the scores, 0 where there is no setting, and which settings exist [X, L, K]. Raises as `region` does."""
    scores = np.asarray(scores, np.float64)
    if scores.ndim != 4 or scores.shape[1] < 2 or 0 in scores.shape:
        raise UserError(f"a region needs scores [X, L, K, S] of at least two lines, and there are {list(scores.shape)}")
    need_runs(scores.shape[-1], 2, "a region's interval")
    finite = np.isfinite(scores)
    exists = finite.any(axis=-1)
    partial = exists & ~finite.all(axis=-1)
    if partial.any():
        raise UserError(
            f"a region needs a score of every run: {int(partial.sum()):,} of {int(exists.sum()):,} settings lack some; leave "
            "these out, or launch the study again"
        )
    empty = ~exists.any(axis=2)
    if empty.any():
        raise UserError(
            f"a region needs every line at every x-value: {int(empty.sum()):,} of {empty.size:,} points have no setting"
        )
    return np.where(finite, scores, 0.0), exists


def best_lines(means: np.ndarray, exists: np.ndarray) -> np.ndarray:
    """Return the highest of means [..., X, L, K] over the settings that exist: [..., X, L]."""
    return np.where(exists, means, -np.inf).max(axis=-1)


def expected_noise(
    scores: np.ndarray, exists: np.ndarray, resamples: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the expected width without an effect [X], the same for one remaining setting [X], and σ.

    Residuals about a setting's mean and about what the lines of the same (x, remaining setting) have in common on a seed:
    (lines − 1)(S − 1) degrees of freedom.
    """
    L, S = scores.shape[1], scores.shape[-1]
    present = exists[..., None]
    num_lines = present.sum(axis=1, keepdims=True)  # [X, 1, K, 1]
    residuals = np.where(present, scores - scores.mean(axis=-1, keepdims=True), 0)
    residuals = np.where(present, residuals - residuals.sum(axis=1, keepdims=True) / np.maximum(num_lines, 1), 0)
    squares = (residuals**2).sum(axis=(1, 3))
    degrees = np.maximum(num_lines[:, 0, :, 0] - 1, 0) * (S - 1)
    at_x = np.sqrt(squares.sum(axis=1) / np.maximum(degrees.sum(axis=1), 1))
    # a remaining setting that one line alone has is given the noise of the others at its x-value
    sigma = np.where(degrees > 0, np.sqrt(squares / np.maximum(degrees, 1)), at_x[:, None])
    pooled = scores.mean(axis=-1).sum(axis=1) / np.maximum(exists.sum(axis=1), 1)
    draws = generator.standard_normal((resamples, *exists.shape)) * (sigma / np.sqrt(S))[:, None, :]
    widths = np.ptp(best_lines(pooled[:, None, :] + draws, exists), axis=-1)
    noise = float(np.sqrt(squares.sum() / max(int(degrees.sum()), 1)))
    return widths.mean(axis=0), 2 * expected_maximum(L) * at_x / np.sqrt(S), noise


def _split_lines(scores: np.ndarray, exists: np.ndarray, choosing: np.ndarray, scoring: np.ndarray) -> np.ndarray:
    """Return lines [splits, X, L] whose remaining setting one half of the seeds chose and the other scores."""
    on_choice = np.where(exists, np.moveaxis(scores @ choosing.T, -1, 0), -np.inf)
    elsewhere = np.moveaxis(scores @ scoring.T, -1, 0)
    return np.take_along_axis(elsewhere, on_choice.argmax(axis=-1)[..., None], axis=-1)[..., 0]


def _permuted_widths(scores: np.ndarray, exists: np.ndarray, permutations: int, generator: np.random.Generator) -> np.ndarray:
    """Return mean widths [permutations] of permutations of the runs.

    Within each seed, x-value and remaining setting the lines that exist are turned in a circle by a random number of places. Such
    turns form a group, so that the test is as exact as with all permutations, at a twentieth of the time.
    """
    X, L, K, S = scores.shape
    means = np.full((permutations, X, L, K), -np.inf)
    for x, k in zip(*np.nonzero(exists.any(axis=1)), strict=True):
        present = np.flatnonzero(exists[x, :, k])
        num_lines = len(present)
        turned = np.stack([np.roll(scores[x, present, k], places, axis=0) for places in range(num_lines)])  # [place, line, S]
        chosen = np.zeros((permutations, S, num_lines))
        np.put_along_axis(chosen, generator.integers(num_lines, size=(permutations, S))[..., None], 1.0, axis=2)
        flat = turned.transpose(2, 0, 1).reshape(S * num_lines, num_lines)
        means[:, x, present, k] = chosen.reshape(permutations, -1) @ flat / S
    return np.ptp(means.max(axis=-1), axis=-1).mean(axis=-1)
