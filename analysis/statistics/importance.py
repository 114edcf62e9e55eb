"""Importance: how much of the differences between settings is due to each hyperparameter, and to each pair (functional ANOVA).

On a full grid the decomposition is exact: the mean score of a setting is the grand mean + a main effect of each hyperparameter +
an interaction of each pair + higher ones, all orthogonal, and the variance over settings is the sum of theirs. Means over n seeds
carry noise of variance σ²/n, of which the effect with d degrees of freedom gets d/H (H settings): it is removed, so that noise is
not called an interaction. What remains is unbiased, and may be negative where there is no effect; it is kept, and named in
`negative`. σ² is that of runs about their setting's mean, without the luck that all settings share on a seed, which moves no
effect.

Intervals resample seeds, the same for all settings. A resample has the noise of the data and its own: both are removed.

With `top` < 1 only the best settings are told apart: means below the quantile count as the quantile (as in fANOVA with a cutoff;
Hutter, Hoos and Leyton-Brown 2014). This is an approximation: noise is removed in proportion to the settings above it.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.statistics.estimate import Estimate
from analysis.statistics.factors import find_factors, on_full_grid
from analysis.statistics.seed_resampling import need_complete, percentiles, seed_counts
from sweep.messages import UserError

_BLOCK = 4_000_000  # numbers in memory at once


@dataclass(frozen=True)
class Component:
    """The effect of one hyperparameter, of a pair, or of all higher interactions together (`factors` empty).

    `variance`: of the effect over settings, noise removed. `share`: of the sum over components; the shares sum up to 1.
    """

    factors: tuple[str, ...]
    degrees_of_freedom: int
    variance: float
    share: Estimate

    @property
    def label(self) -> str:
        """`entropy_scale`, `critic_step_size × entropy_scale`, or `higher interactions`."""
        return " × ".join(self.factors) or "higher interactions"


@dataclass(frozen=True)
class Importance:
    """The components, main effects first, each group by descending share.

    `variance`: of the settings' means, noise removed, the sum over components. `noise_variance`: what was removed. `negative`:
    labels of components whose estimate is below 0: no effect that these runs can show. `top`: the share of settings told apart.
    `shares_defined`: False where settings differ by no more than noise; all shares are NaN then. `undefined_resamples`: resamples
    in which they do, and which intervals leave out: where there are many, shares say little.
    """

    components: tuple[Component, ...]
    variance: float
    noise_variance: float
    negative: tuple[str, ...]
    shares_defined: bool
    undefined_resamples: int
    top: float
    method: str
    num_settings: int
    num_runs: int
    resamples: int
    seed: int


def decompose(
    scores: np.ndarray,
    hypers: Mapping[str, Sequence[Any]],
    *,
    together: Iterable[Sequence[str]] = (),
    top: float = 1.0,
    confidence: float = 0.95,
    resamples: int = 1_000,
    seed: int,
) -> Importance:
    """Decompose the variance of the means of settings [H, S] with the values `hypers` [H each], which form a full grid.

    `together`: names that are one factor, as in a `zip`. Raises UserError where a run has no score, the grid is not full (naming
    missing combinations), nothing varies or `top` is not in (0, 1]; TooFewRunsError below two seeds.
    """
    scores = need_complete(scores, "an importance", "HS")
    if not 0 < top <= 1:
        raise UserError(f"top: {top:g} is no share of settings; it lies above 0 and is at most 1")
    factors = find_factors(hypers, together)
    if not factors.names:
        raise UserError("an importance needs a hyperparameter that varies, and these settings have none")
    grid = on_full_grid(scores, factors, "an importance")
    shape, S = grid.shape[:-1], grid.shape[-1]
    subsets = _subsets(len(shape))
    degrees = _degrees(shape, subsets)
    flat = grid.reshape(-1, S)

    ones = np.ones((1, S))
    means = flat @ ones.T / S
    removed = _noise(flat, ones, means.T, top) * degrees / len(flat)
    variances = _variances(_capped(means.T, top).reshape(1, *shape), subsets)[0] - removed[0]
    total = float(variances.sum())
    drawn = np.concatenate(list(_resampled(flat, shape, subsets, degrees, top, resamples, seed))) - removed
    defined = total > 0
    usable = drawn[drawn.sum(axis=1) > 0]
    low = high = np.full(len(variances), np.nan)
    if defined and len(usable):
        low, high = percentiles(usable / usable.sum(axis=1, keepdims=True), confidence)
    components = [
        Component(
            factors=tuple(factors.labels[axis] for axis in subset),
            degrees_of_freedom=int(degrees[index]),
            variance=float(variances[index]),
            share=Estimate(
                value=float(variances[index] / total) if defined else float("nan"),
                low=float(low[index]),
                high=float(high[index]),
                confidence=confidence,
                method="paired percentile bootstrap",
                num_runs=S,
                resamples=resamples,
                seed=seed,
            ),
        )
        for index, subset in enumerate([*subsets, ()])
        if subset or degrees[index]
    ]
    components.sort(key=lambda component: (len(component.factors) or 3, -component.variance))
    return Importance(
        components=tuple(components),
        variance=total,
        noise_variance=float(removed.sum()),
        negative=tuple(component.label for component in components if component.variance < 0),
        shares_defined=defined,
        undefined_resamples=len(drawn) - len(usable),
        top=top,
        method="functional ANOVA on the full grid" + ("" if top == 1 else f", means below the best {top:.0%} of settings capped"),
        num_settings=len(flat),
        num_runs=S,
        resamples=resamples,
        seed=seed,
    )


def _subsets(num_factors: int) -> list[tuple[int, ...]]:
    """Return the axes of each main effect, then those of each pair."""
    return [(axis,) for axis in range(num_factors)] + list(itertools.combinations(range(num_factors), 2))


def _degrees(shape: tuple[int, ...], subsets: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Return the degrees of freedom of each subset, and last of all that remains."""
    degrees = [int(np.prod([shape[axis] - 1 for axis in subset])) for subset in subsets]
    return np.array([*degrees, int(np.prod(shape)) - 1 - sum(degrees)], np.float64)


def _variances(means: np.ndarray, subsets: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Return the variance [B, subsets + 1] of each effect over the settings of means [B, grid], the rest last."""
    axes = range(1, means.ndim)
    centered = means - means.mean(axis=tuple(axes), keepdims=True)
    effects: dict[tuple[int, ...], np.ndarray] = {}
    for subset in subsets:
        others = tuple(axis for axis in axes if axis - 1 not in subset)
        effect = centered.mean(axis=others, keepdims=True)
        for axis in subset if len(subset) == 2 else ():
            effect = effect - effects[axis,]
        effects[subset] = effect
    parts = np.stack([np.mean(effect.reshape(len(means), -1) ** 2, axis=1) for effect in effects.values()], axis=1)
    total = np.mean(centered.reshape(len(means), -1) ** 2, axis=1)
    return np.column_stack([parts, total - parts.sum(axis=1)])


def _noise(flat: np.ndarray, counts: np.ndarray, means: np.ndarray, top: float) -> np.ndarray:
    """Return σ²/n [B, 1] of the runs [H, S], each counted so many times [B, S], times the share of settings that are not capped.

    `means`: [B, H] of the same resamples.
    """
    H, S = flat.shape
    if H == 1:
        return np.zeros((len(counts), 1))
    luck = flat.mean(axis=0)  # what all settings have in common on a seed
    own = means - (counts @ luck / S)[:, None]
    squares = counts @ ((flat - luck) ** 2).sum(axis=0) - S * (own**2).sum(axis=1)
    share = 1.0 if top == 1 else (means >= _cutoff(means, top)).mean(axis=1)
    return (squares / ((H - 1) * (S - 1)) / S * share)[:, None]


def _capped(means: np.ndarray, top: float) -> np.ndarray:
    return means if top == 1 else np.maximum(means, _cutoff(means, top))


def _cutoff(means: np.ndarray, top: float) -> np.ndarray:
    """Return the lowest mean [B, 1] among the best settings of [B, H]: `top` of them, rounded up."""
    kept = int(np.ceil(top * means.shape[1]))
    return -np.partition(-means, kept - 1, axis=1)[:, kept - 1 : kept]


def _resampled(
    flat: np.ndarray,
    shape: tuple[int, ...],
    subsets: Sequence[tuple[int, ...]],
    degrees: np.ndarray,
    top: float,
    resamples: int,
    seed: int,
) -> Iterator[np.ndarray]:
    """Yield variances [b, subsets + 1] over resampled seeds, the noise of the resampling removed."""
    H, S = flat.shape
    generator = np.random.default_rng(seed)
    size = max(1, _BLOCK // H)
    for start in range(0, resamples, size):
        counts = seed_counts(S, min(size, resamples - start), generator)
        means = counts @ flat.T / S
        drawn = _variances(_capped(means, top).reshape(-1, *shape), subsets)
        yield drawn - _noise(flat, counts, means, top) * degrees / H
