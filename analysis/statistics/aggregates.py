"""One number for an algorithm on many tasks, with its stratified bootstrap interval (Agarwal et al. 2021).

Scores are normalized before (`sweep.normalizers`); their forms are those of `analysis.statistics.stratified`.

    mean            mean over tasks of the mean over runs
    median          median over tasks of the mean over runs
    iqm             mean of the middle half of all scores, runs × tasks: 25 % are trimmed at each end
    optimality_gap  1 − mean of min(score, 1)

With different numbers of runs a task, `iqm` pools the runs as they are; in all others each task counts the same.
"""

from collections.abc import Callable

import numpy as np

from analysis.statistics.bootstrap import RESAMPLES, percentile_ends
from analysis.statistics.estimate import Estimate
from analysis.statistics.samples import Array, check_name, check_share
from analysis.statistics.stratified import Scores, TaskScores, describe, distribution, take_tasks
from sweep.messages import UserError

Aggregate = Callable[[Array], Array]
TRIMMED = 0.25  # at each end


def task_means(scores: Array) -> Array:
    """Return the mean over the runs of each task, [..., tasks], of scores [..., tasks, runs] with NaN where there is no run."""
    return np.asarray(np.nanmean(scores, axis=-1) if np.isnan(scores[..., -1]).any() else scores.mean(-1))


def mean(scores: Array) -> Array:
    """Return the mean of task means, [...], of scores [..., tasks, runs]."""
    return np.asarray(task_means(scores).mean(-1))


def median(scores: Array) -> Array:
    """Return the median of task means, [...], of scores [..., tasks, runs]."""
    return np.asarray(np.median(task_means(scores), axis=-1))


def interquartile_mean(scores: Array) -> Array:
    """Return the mean of what remains when ⌊N/4⌋ of the N scores are trimmed at each end, [...], of scores [..., tasks, runs]."""
    pool = np.sort(scores.reshape(*scores.shape[:-2], -1), axis=-1)
    present = np.count_nonzero(~np.isnan(pool), axis=-1)  # NaN is sorted to the end
    cut = (TRIMMED * present).astype(np.int64)
    if present.min() == present.max():
        start, stop = int(cut.flat[0]), int((present - cut).flat[0])
        return np.asarray(pool[..., start:stop].mean(-1))
    place = np.arange(pool.shape[-1])
    kept = (place >= cut[..., None]) & (place < (present - cut)[..., None])
    return np.asarray(np.mean(pool, axis=-1, where=kept))


def optimality_gap(scores: Array, best: float = 1.0) -> Array:
    """Return best − mean of min(score, best), [...], of scores [..., tasks, runs]."""
    return np.asarray(best - mean(np.minimum(scores, best)))


AGGREGATES: dict[str, Aggregate] = {
    "mean": mean,
    "median": median,
    "iqm": interquartile_mean,
    "optimality_gap": optimality_gap,
}


def find(name: str) -> Aggregate:
    """Return the aggregate of a name. Raises UserError, with the nearest name, for an unknown one."""
    check_name(name, AGGREGATES, "aggregate")
    return AGGREGATES[name]


def aggregate(
    scores: Scores,
    name: str = "iqm",
    confidence: float = 0.95,
    paired: bool = False,
    tasks: bool = False,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """Return an aggregate, one of `AGGREGATES`, of an algorithm's scores. `num_runs` is the least of a task.

    Raises TooFewRunsError where a task has fewer than two runs; UserError for an unknown aggregate, for NaN, and for paired seeds
    that differ in number. `paired` and `tasks`: as in `analysis.statistics.stratified`.
    """
    statistic = find(name)
    groups = [take_tasks(scores, name)]
    return _estimate(statistic, groups, confidence, paired, tasks, resamples, seed)


def aggregate_difference(
    first: Scores,
    second: Scores,
    name: str = "iqm",
    confidence: float = 0.95,
    paired: bool = False,
    tasks: bool = False,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """Return the aggregate of the first algorithm less that of the second, on the same tasks in the same order.

    With `paired` both are given the same resampled seeds. Raises like `aggregate`.
    """
    statistic = find(name)
    groups = _same_tasks(first, second, name)
    return _estimate(lambda x, y: statistic(x) - statistic(y), groups, confidence, paired, tasks, resamples, seed)


def improvement(first: Array, second: Array) -> Array:
    """Return P(X > Y) + ½ P(X = Y), averaged over tasks, [...], of two arrays [..., tasks, runs]; NaN where there is no run."""
    return np.asarray(_superiority(first, second).mean(-1))


def probability_of_improvement(
    first: Scores,
    second: Scores,
    confidence: float = 0.95,
    paired: bool = False,
    tasks: bool = False,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """Return how probably a run of the first algorithm is better than one of the second on the same task, over all tasks.

    It is the Mann–Whitney U, divided by the number of pairs of runs, averaged over tasks. Raises like `aggregate`.
    """
    groups = _same_tasks(first, second, "probability of improvement")
    return _estimate(improvement, groups, confidence, paired, tasks, resamples, seed)


def _same_tasks(first: Scores, second: Scores, what: str) -> list[TaskScores]:
    if isinstance(first, dict) and isinstance(second, dict):
        if set(first) != set(second):
            raise UserError(f"{what}: only one of the two has scores on {', '.join(sorted(set(first) ^ set(second)))}")
        second = {task: second[task] for task in first}
    return [take_tasks(first, what), take_tasks(second, what)]


def _superiority(first: Array, second: Array) -> Array:
    wins = np.zeros(first.shape[:-1])
    # one run of the first at a time: all pairs at once would take n times the memory
    for run in range(first.shape[-1]):
        score = first[..., run, None]
        wins += (score > second).sum(-1) + (score == second).sum(-1) / 2
    return np.asarray(wins / ((~np.isnan(first)).sum(-1) * (~np.isnan(second)).sum(-1)))


def _estimate(
    statistic: Callable[..., Array],
    groups: list[TaskScores],
    confidence: float,
    paired: bool,
    tasks: bool,
    resamples: int,
    seed: int,
) -> Estimate:
    check_share(confidence, "confidence")
    if any(len(group.values) > 1 for group in groups):
        raise UserError("scores at one checkpoint are needed; `sample_efficiency` takes several")
    resampled = distribution(statistic, groups, resamples, seed, paired, tasks)
    low, high = percentile_ends(resampled[0], confidence)
    value = float(statistic(*(group.values for group in groups))[0])
    num_runs = int(min(group.num_runs.min() for group in groups))
    return Estimate(value, float(low), float(high), confidence, describe(paired, tasks), num_runs, resamples, seed)
