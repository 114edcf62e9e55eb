"""Hyperparameter sensitivity and effective dimensionality (Adkins, Bowling and White 2024), on normalized scores [E, H, S].

    tuned        mean over environments of the best setting of each: mean_e max_h Γ
    compromise   the best single setting for all environments: max_h mean_e Γ
    sensitivity  Φ = tuned − compromise ≥ 0: what tuning to each environment gains

In the plane of sensitivity (x) and tuned score (y), points on a line of slope 1 have the same compromise. So the horizontal line
and the line of slope 1 through a reference algorithm tell where another is better: tuned to each environment, with one setting
for all, in both ways or in neither.

The effective dimensionality is the smallest number of hyperparameters that, tuned to each environment while the others keep their
values of the compromise, reach 95 % of the tuned score. A share of a score means something only where 0 does: it is refused for
the thesis' normalizer, whose 0 is no bound.

All of these are maxima over noisy means, Φ too: it is above 0 by luck alone. `evaluated` gives it from fresh seeds of the
settings that tuning chose, without that luck. Environments weigh the same; the same settings are candidates in all of them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.statistics.estimate import Estimate
from analysis.statistics.factors import Factors, find_factors
from analysis.statistics.seed_resampling import need_complete, percentiles, resampled_means, winners
from sweep.messages import UserError

ZERO_ANCHORED = ("minmax", "percentile", "cdf")
_MOST_FACTORS = 12  # 4,096 subsets


@dataclass(frozen=True)
class Sensitivity:
    """A point of the plane.

    `best_per_environment` [E], `best_across`: indices of settings, of equally good ones the first.
    """

    sensitivity: Estimate
    tuned: Estimate
    compromise: Estimate
    best_per_environment: tuple[int, ...]
    best_across: int
    num_settings: int
    num_runs: int


@dataclass(frozen=True)
class Dimensionality:
    """How many hyperparameters need tuning to each environment.

    `subset_scores`: the score with these factors free, for every subset. `best_scores` [M + 1], `best_subsets`: the best of m
    free factors, m = 0 … M. `dimensionality`: the smallest m with at least `share` of the score of all; `interpolated`: where a
    straight line between neighbors crosses it, an extra. `probabilities` [M + 1]: the share of resamples that have each
    dimensionality.
    """

    dimensionality: int
    interpolated: float
    subset_scores: dict[tuple[str, ...], float]
    best_scores: np.ndarray
    best_subsets: tuple[tuple[str, ...], ...]
    share: float
    defaults: int
    """The compromise, whose values the others keep."""
    probabilities: np.ndarray
    num_settings: int
    num_runs: int
    paired: bool
    resamples: int
    seed: int


def sensitivity(
    scores: np.ndarray, *, paired: bool = True, confidence: float = 0.95, resamples: int = 10_000, seed: int
) -> Sensitivity:
    """Return Φ and the point of the plane of one algorithm's scores [E, H, S], with intervals over resampled runs.

    `paired` resamples seeds, the same in all settings and environments. Raises UserError for a run without a score,
    TooFewRunsError below two seeds.
    """
    scores = need_complete(scores, "a sensitivity", "EHS")
    means = scores.mean(axis=-1)
    generator = np.random.default_rng(seed)
    drawn = np.concatenate([_plane(block) for block in resampled_means(scores, resamples, generator, paired=paired)])
    method = f"{'paired ' if paired else ''}percentile bootstrap"
    phi, tuned, compromise = _estimates(_plane(means[None])[0], drawn, confidence, method, scores.shape[-1], seed)
    return Sensitivity(
        sensitivity=phi,
        tuned=tuned,
        compromise=compromise,
        best_per_environment=tuple(map(int, winners(means))),
        best_across=int(winners(means.mean(axis=0))),
        num_settings=scores.shape[1],
        num_runs=scores.shape[-1],
    )


def evaluated(
    tuned: np.ndarray, compromise: np.ndarray, *, confidence: float = 0.95, resamples: int = 10_000, seed: int
) -> tuple[Estimate, Estimate, Estimate]:
    """Return Φ, tuned and compromise from evaluation runs [E, S] of the settings chosen per environment and across environments.

    Unbiased, so that Φ may be negative. Seeds are resampled, the same in both arrays: where both rules chose one setting its runs
    are the same, and add nothing to Φ. Raises UserError for a run without a score or different shapes, TooFewRunsError below two.
    """
    both = [need_complete(scores, "an evaluated sensitivity", "ES") for scores in (tuned, compromise)]
    if both[0].shape != both[1].shape:
        raise UserError(
            f"an evaluated sensitivity needs the same environments and seeds of both: {both[0].shape}, {both[1].shape}"
        )
    stacked = np.stack(both)
    drawn = np.concatenate(list(resampled_means(stacked, resamples, np.random.default_rng(seed)))).mean(axis=-1)
    point = stacked.mean(axis=(1, 2))[None]
    phi, *others = _estimates(
        _with_difference(point)[0], _with_difference(drawn), confidence, "paired percentile bootstrap", len(both[0][0]), seed
    )
    return phi, others[0], others[1]


def plane_region(sensitivity: float, tuned: float, reference_sensitivity: float, reference_tuned: float) -> str:
    """Return where a point of the plane lies relative to a reference algorithm's; on a line counts as better.

    "better either way", "better only tuned to each environment", "better only with one setting for all", "worse either way".
    """
    above = tuned >= reference_tuned
    left = tuned - sensitivity >= reference_tuned - reference_sensitivity
    if above:
        return "better either way" if left else "better only tuned to each environment"
    return "better only with one setting for all" if left else "worse either way"


def effective_dimensionality(
    scores: np.ndarray,
    hypers: Mapping[str, Sequence[Any]],
    *,
    normalizer: str,
    together: Iterable[Sequence[str]] = (),
    planned: Mapping[str, Sequence[Any]] | None = None,
    share: float = 0.95,
    paired: bool = True,
    resamples: int = 1_000,
    seed: int,
) -> Dimensionality:
    """Return how many of the hyperparameters (`hypers`: name → value of each of H settings) need tuning, of scores [E, H, S].

    Those that always vary together are one, as are those named in `together`; `planned` are the values of all settings of the
    grid, where `scores` are of a part. The grid need not be full. In resamples the compromise is chosen anew. Raises UserError
    where nothing varies, 0 of the normalizer means nothing, the tuned score is not positive, more than 12 hyperparameters vary,
    or as `sensitivity` does.
    """
    if normalizer not in ZERO_ANCHORED:
        raise UserError(
            f'an effective dimensionality is {share:.0%} of a score, which means nothing with normalizer "{normalizer}": its 0 '
            f"is not the low end of a scale; choose one of {', '.join(ZERO_ANCHORED)}"
        )
    scores = need_complete(scores, "an effective dimensionality", "EHS")
    factors = find_factors(hypers, together, planned)
    if not factors.names:
        raise UserError("an effective dimensionality needs a hyperparameter that varies, and these settings have none")
    if len(factors.names) > _MOST_FACTORS:
        raise UserError(
            f"an effective dimensionality tries all subsets of at most {_MOST_FACTORS} hyperparameters, not {len(factors.names)}"
        )
    means = scores.mean(axis=-1)
    tuned = float(means.max(axis=1).mean())
    if tuned <= 0:
        raise UserError(f"an effective dimensionality is {share:.0%} of the tuned score, which is not positive: {tuned:.4g}")
    by_subset = _subset_scores(means[None], factors)[0]
    best = _best_of_size(by_subset[None], len(factors.names))
    generator = np.random.default_rng(seed)
    found = [
        _smallest(_best_of_size(_subset_scores(block, factors), len(factors.names)), share)
        for block in resampled_means(scores, resamples, generator, paired=paired)
    ]
    labels = factors.labels
    sizes = _sizes(len(labels))
    names = [tuple(label for bit, label in enumerate(labels) if code >> bit & 1) for code in range(len(by_subset))]
    smallest = int(_smallest(best, share)[0])
    return Dimensionality(
        dimensionality=smallest,
        interpolated=_crossing(best[0], smallest, share),
        subset_scores={names[code]: float(by_subset[code]) for code in np.argsort(sizes, kind="stable")},
        best_scores=best[0],
        best_subsets=tuple(
            names[int(np.flatnonzero(sizes == size)[winners(by_subset[sizes == size])])] for size in range(len(labels) + 1)
        ),
        share=share,
        defaults=int(winners(means.mean(axis=0))),
        probabilities=np.bincount(np.concatenate(found), minlength=len(labels) + 1) / resamples,
        num_settings=scores.shape[1],
        num_runs=scores.shape[-1],
        paired=paired,
        resamples=resamples,
        seed=seed,
    )


def _plane(means: np.ndarray) -> np.ndarray:
    """Return Φ, tuned and compromise [B, 3] of means [B, E, H]."""
    return _with_difference(np.stack([means.max(axis=2).mean(axis=1), means.mean(axis=1).max(axis=1)], axis=1))


def _with_difference(pairs: np.ndarray) -> np.ndarray:
    return np.column_stack([pairs[:, 0] - pairs[:, 1], pairs])


def _estimates(values: np.ndarray, draws: np.ndarray, confidence: float, method: str, num_runs: int, seed: int) -> list[Estimate]:
    low, high = percentiles(draws, confidence)
    return [
        Estimate(float(value), float(low[i]), float(high[i]), confidence, method, num_runs, len(draws), seed)
        for i, value in enumerate(values)
    ]


def _subset_scores(means: np.ndarray, factors: Factors) -> np.ndarray:
    """Return the score [B, subsets] with each subset of factors free, from means [B, E, H]; bit i of a subset is factor i."""
    num_factors = len(factors.names)
    defaults = winners(means.mean(axis=1))
    scores = np.empty((len(means), 2**num_factors))
    for default in np.unique(defaults):
        rows = np.flatnonzero(defaults == default)
        differs = factors.positions != factors.positions[default]
        codes = differs.astype(int) @ (1 << np.arange(num_factors))
        best = np.full((len(rows), means.shape[1], 2**num_factors), -np.inf)
        order = np.argsort(codes, kind="stable")
        present, starts = np.unique(codes[order], return_index=True)
        best[:, :, present] = np.maximum.reduceat(means[rows][:, :, order], starts, axis=2)
        for bit in range(num_factors):  # a subset has the settings of all subsets within it
            with_bit = np.flatnonzero(np.arange(2**num_factors) >> bit & 1)
            best[:, :, with_bit] = np.maximum(best[:, :, with_bit], best[:, :, with_bit ^ (1 << bit)])
        scores[rows] = best.mean(axis=1)
    return scores


def _sizes(num_factors: int) -> np.ndarray:
    return np.array([code.bit_count() for code in range(2**num_factors)])


def _best_of_size(by_subset: np.ndarray, num_factors: int) -> np.ndarray:
    """Return the best score [B, M + 1] of each number of free factors."""
    sizes = _sizes(num_factors)
    return np.stack([by_subset[:, sizes == size].max(axis=1) for size in range(num_factors + 1)], axis=1)


def _smallest(best: np.ndarray, share: float) -> np.ndarray:
    """Return the smallest number of free factors [B] that reaches the share of the score of all."""
    return (best >= share * best[:, -1:] * (1 - 1e-12)).argmax(axis=1)


def _crossing(best: np.ndarray, smallest: int, share: float) -> float:
    if smallest == 0:
        return 0.0
    below, above = best[smallest - 1], best[smallest]
    return float(smallest - 1 + (share * best[-1] - below) / (above - below))
