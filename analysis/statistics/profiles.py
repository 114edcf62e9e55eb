"""Curves over many tasks: performance profiles, and sample efficiency (Agarwal et al. 2021).

A performance profile is the share of scores above each threshold: of all runs × tasks (`runs`), which is unbiased, or of the
tasks' means (`task_means`). Where one profile lies above another everywhere, the algorithm is stochastically better.
"""

import numpy as np
from numpy.typing import ArrayLike

from analysis.statistics import aggregates
from analysis.statistics.bands import Band
from analysis.statistics.bootstrap import percentile_ends
from analysis.statistics.samples import Array, check_name, check_share, take
from analysis.statistics.stratified import Scores, TaskScores, describe, distribution, take_tasks
from sweep.messages import UserError

KINDS = ("runs", "task_means")


def performance_profile(
    scores: Scores,
    thresholds: ArrayLike,
    of: str = "runs",
    confidence: float = 0.95,
    paired: bool = False,
    tasks: bool = False,
    resamples: int = 2_000,
    seed: int = 0,
) -> Band:
    """Return the share of scores strictly above each threshold [points], with a pointwise band.

    Each task counts the same, however many runs it has. Raises TooFewRunsError where a task has fewer than two runs, UserError
    for an unknown `of` and for NaN.
    """
    check_name(of, KINDS, "kind of profile")
    levels = take(thresholds, "thresholds")
    group = take_tasks(scores, "performance profile")
    if len(group.values) > 1:
        raise UserError("performance profile: scores at one checkpoint are needed")

    def shares(drawn: Array) -> Array:
        if of == "task_means":
            means = aggregates.task_means(drawn)[0]
            return np.stack([(means > level).mean(-1) for level in levels])
        present = (~np.isnan(drawn[0])).sum(-1)
        # NaN is above nothing
        return np.stack([((drawn[0] > level).sum(-1) / present).mean(-1) for level in levels])

    resampled = distribution(shares, [group], resamples, seed, paired, tasks)
    return _band(shares(group.values[:, None])[:, 0], resampled, group, confidence, paired, tasks, seed)


def sample_efficiency(
    scores: Scores,
    name: str = "iqm",
    confidence: float = 0.95,
    paired: bool = False,
    tasks: bool = False,
    resamples: int = 2_000,
    seed: int = 0,
) -> Band:
    """Return an aggregate at each checkpoint, of scores with an axis of checkpoints, with a pointwise band.

    Whole runs are resampled: a run is the same one at all checkpoints. Raises like `aggregates.aggregate`.
    """
    statistic = aggregates.find(name)
    group = take_tasks(scores, name)
    resampled = distribution(statistic, [group], resamples, seed, paired, tasks)
    return _band(statistic(group.values), resampled, group, confidence, paired, tasks, seed)


def _band(value: Array, resampled: Array, group: TaskScores, confidence: float, paired: bool, tasks: bool, seed: int) -> Band:
    check_share(confidence, "confidence")
    low, high = percentile_ends(resampled, confidence)
    num_runs, resamples = int(group.num_runs.min()), resampled.shape[-1]
    return Band(value, low, high, confidence, describe(paired, tasks), num_runs, False, resamples, seed)
