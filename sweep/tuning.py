"""Tuning scores: what the tuning runs of a study amount to, setting by setting, before anything is chosen.

A run's score is one of the columns of `trials` (`[select] score`). A diverged run scores the worst return of the environment
(`worst`), or is left out of its setting's mean (`drop`). A setting has a mean when all its runs are there and have a score.
Means are exactly rounded sums divided by counts: the order in which files are read changes none.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sweep.grid import Grid
from sweep.messages import UserError
from sweep.normalizers import Normalizer, TuningRuns
from sweep.trials import Trial

Place = tuple[str, str, str]  # agent, environment, setting
_DROPPED = "dropped"


class IncompleteError(UserError):
    """Trials of the tuning stage are missing, so that nothing can be chosen yet."""


@dataclass(frozen=True)
class TrialScores:
    """What selection needs to know of a trial: its status, the score chosen by, and the highest return of an episode."""

    status: str
    score: float | None
    best_episode: float | None


@dataclass(frozen=True)
class Measured:
    """A setting on an environment: the scores of its runs, in the order of seeds, and their mean."""

    scores: tuple[float, ...]
    mean: float


def refuse_missing(grid: Grid, trials: Sequence[Trial], scores: Mapping[str, TrialScores]) -> None:
    """Raise IncompleteError, with how many of which agent on which environment, when any of the trials is missing or failed."""
    planned: dict[tuple[str, str], int] = {}
    missing: dict[tuple[str, str], int] = {}
    for trial in trials:
        place = (trial.agent, trial.environment)
        planned[place] = planned.get(place, 0) + 1
        if not _is_there(scores.get(trial.id)):
            missing[place] = missing.get(place, 0) + 1
    if missing:
        lines = [
            f"{agent} on {environment}: {count:,} of {planned[agent, environment]:,}"
            for (agent, environment), count in missing.items()
        ]
        raise IncompleteError(
            f"{grid.name}: nothing can be chosen: {sum(missing.values()):,} of {len(trials):,} tuning trials are missing or have "
            "failed:\n"
            + "".join(f"  {line}\n" for line in lines)
            + "`sweep launch` trains them; `--allow-partial` chooses among the settings that lack none"
        )


def _is_there(scores: TrialScores | None) -> bool:
    return scores is not None and scores.status in ("finished", "diverged")


def measure(
    grid: Grid, trials: Sequence[Trial], scores: Mapping[str, TrialScores], worst_returns: Mapping[str, float]
) -> dict[Place, Measured]:
    """Return the settings that can be compared."""
    runs: dict[Place, dict[int, Trial]] = {}
    for trial in trials:
        runs.setdefault((trial.agent, trial.environment, trial.setting), {})[trial.seed] = trial
    measured = {}
    for place, by_seed in runs.items():
        known = [_run_score(grid, by_seed[seed], scores, worst_returns) for seed in sorted(by_seed)]
        counted = tuple(score for score in known if isinstance(score, float))
        if counted and None not in known:
            measured[place] = Measured(counted, math.fsum(counted) / len(counted))
    return measured


def _run_score(
    grid: Grid, trial: Trial, scores: Mapping[str, TrialScores], worst_returns: Mapping[str, float]
) -> float | str | None:
    """Return the score, _DROPPED for a run that its setting's mean does without, None for one without which it has none."""
    known = scores.get(trial.id)
    if known is None or not _is_there(known):
        return None
    if known.status == "diverged":
        if grid.select.diverged == "drop":
            return _DROPPED
        score = worst_returns.get(trial.environment)
    else:
        score = known.score
    return float(score) if score is not None and math.isfinite(score) else None


def normalizer(
    grid: Grid, trials: Sequence[Trial], scores: Mapping[str, TrialScores], measured: Mapping[Place, Measured]
) -> Normalizer:
    """Return the study's normalizer. G* is that of all tuning trials, the rest is of the settings that can be compared."""
    best: dict[str, float] = {}
    for trial in trials:
        known = scores.get(trial.id)
        if known is not None and known.best_episode is not None:
            best[trial.environment] = max(best.get(trial.environment, -math.inf), known.best_episode)
    means: dict[str, list[float]] = {}
    runs: dict[str, dict[str, list[float]]] = {}
    for (agent, environment, _), setting in measured.items():
        means.setdefault(environment, []).append(setting.mean)
        runs.setdefault(environment, {}).setdefault(agent, []).extend(setting.scores)
    pooled = {environment: TuningRuns(best[environment], means[environment], runs[environment]) for environment in means}
    return Normalizer.from_runs(grid.select.normalizer, pooled)
