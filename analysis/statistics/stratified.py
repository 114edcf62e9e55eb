"""The stratified bootstrap: runs are resampled within each task, and the tasks themselves where that is asked for.

Scores of an algorithm on several tasks (environments) are, wherever they are taken, either

    an array [runs, tasks] or [runs, tasks, checkpoints]   every task has the same number of runs (rliable's layout)
    a list, or a dict by name, of arrays [runs of the task] or [runs of the task, checkpoints]

`paired`: row i of every task, and of every algorithm that is compared, is the same seed, and seeds are drawn once for all of
them. `tasks`: tasks are drawn too, which says how much a result depends on the choice of tasks (Agarwal et al. 2021); two
algorithms are given the same tasks.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.statistics.bootstrap import chunk_sizes
from analysis.statistics.estimate import need_runs
from analysis.statistics.samples import Array, check_count, take
from sweep.messages import UserError

Scores = ArrayLike | Sequence[ArrayLike] | Mapping[str, ArrayLike]


@dataclass(frozen=True)
class TaskScores:
    """Scores [checkpoints, tasks, most runs], NaN after the last run of a task, and the number of runs [tasks].

    Scores without checkpoints have one.
    """

    values: Array
    num_runs: NDArray[np.int64]


def take_tasks(scores: Scores, what: str, least: int = 2) -> TaskScores:
    """Return scores by task, in whichever form they come (module docstring).

    Raises TooFewRunsError where a task has fewer runs than `least`; UserError without tasks, and for NaN.
    """
    if isinstance(scores, Mapping):
        names, given = [f"{what}, {name}" for name in scores], list(scores.values())
    elif isinstance(scores, np.ndarray):
        whole = take(scores, what, (2, 3))
        names, given = [what] * whole.shape[1], [whole[:, task] for task in range(whole.shape[1])]
    else:
        given = list(scores)  # type: ignore[arg-type]
        names = [f"{what}, task {number}" for number in range(len(given))]
    if not given:
        raise UserError(f"{what}: there is no task")
    tasks = [take(task, name, (1, 2)) for name, task in zip(names, given, strict=True)]
    if len({task.shape[1:] for task in tasks}) > 1:
        raise UserError(f"{what}: tasks have different numbers of checkpoints")
    for task, name in zip(tasks, names, strict=True):
        need_runs(len(task), least, name)
    counts = np.array([len(task) for task in tasks])
    values = np.full((tasks[0][0].size, len(tasks), counts.max()), np.nan)
    for number, task in enumerate(tasks):
        values[:, number, : len(task)] = task.reshape(len(task), -1).T
    return TaskScores(values, counts)


def resample(
    groups: Sequence[TaskScores], resamples: int, seed: int, paired: bool = False, tasks: bool = False
) -> Iterator[list[Array]]:
    """Yield, chunk by chunk, resamples [checkpoints, chunk, tasks, most runs] of each algorithm; NaN as in `TaskScores`.

    Raises UserError where algorithms have different numbers of tasks, and where paired seeds differ in number.
    """
    check_count(resamples, "resamples")
    counts = np.array([group.num_runs for group in groups if len(group.num_runs) == len(groups[0].num_runs)])
    if len(counts) < len(groups):
        raise UserError("algorithms are compared on the same tasks; these have different numbers of them")
    if paired and len(np.unique(counts)) > 1:
        shown = ", ".join(map(str, np.unique(counts)))
        raise UserError(f"paired seeds: every task needs the same number of runs, and there are {shown}")
    rng = np.random.default_rng(seed)
    num_tasks, most = counts.shape[1], int(counts.max())
    for size in chunk_sizes(resamples, max(group.values.size for group in groups)):
        # without `tasks` the draw is the tasks themselves, once each
        drawn = rng.integers(num_tasks, size=(size, num_tasks)) if tasks else np.arange(num_tasks)[None]
        seeds = rng.integers(most, size=(size, 1, most)) if paired else None
        yield [_drawn(group, rng, size, drawn, seeds) for group in groups]


def distribution(
    statistic: Callable[..., Array],
    groups: Sequence[TaskScores],
    resamples: int,
    seed: int,
    paired: bool = False,
    tasks: bool = False,
) -> Array:
    """Return [checkpoints, resamples]: a statistic, called with an array [..., tasks, runs] for each algorithm, of resamples."""
    chunks = [statistic(*drawn) for drawn in resample(groups, resamples, seed, paired, tasks)]
    return np.concatenate(chunks, axis=-1)


def describe(paired: bool, tasks: bool) -> str:
    """Return the name of the bootstrap, for `Estimate.method`."""
    return "stratified bootstrap" + (", paired seeds" if paired else "") + (", tasks resampled" if tasks else "")


def _drawn(
    group: TaskScores, rng: np.random.Generator, size: int, drawn: NDArray[np.int64], seeds: NDArray[np.int64] | None
) -> Array:
    num_tasks, most = len(group.num_runs), group.values.shape[-1]
    counts = group.num_runs[drawn][..., None]
    if seeds is None:
        same = group.num_runs.min() == most
        seeds = rng.integers(most if same else np.broadcast_to(counts, (size, num_tasks, most)), size=(size, num_tasks, most))
    values = group.values[:, drawn[..., None], seeds]
    if group.num_runs.min() < most:
        values[:, np.broadcast_to(np.arange(most) >= counts, values.shape[1:])] = np.nan
    return values
