"""Curves over the course of learning: each run's return at checkpoints, and the mean of runs with what surrounds it.

A step counts the return of the episode it belongs to (thesis 6.1). The steps of the budget-cut last episode repeat the return of
the one before; from the episode on in which a run diverged it counts as the worst return of the environment. A run that completed
no episode has no reading.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from analysis.statistics.bands import band

MOST_POINTS = 500
"""Checkpoints of a curve; a panel is not wider than this many dots."""
RESAMPLES = 2_000

BANDS = {
    "standard-error": "mean ± 1 standard error",
    "student": "mean and pointwise 95 % Student interval",
    "bootstrap": "mean and pointwise 95 % percentile-bootstrap interval over runs",
    "min-max": "mean, lowest and highest run",
    "runs": "mean and each run",
    "none": "mean",
}
"""What surrounds a mean, in words."""
INTERVALS = ("standard-error", "student", "bootstrap")


@dataclass(frozen=True)
class Curve:
    """One line of a panel: the mean of runs at `x` [points], and its band, NaN where there is none.

    `agent`, `environment`, `value`: which line in which panel. `steps` [points] are environment steps; `x` is the same or counts
    episodes. `num_runs` had a reading. `runs` [runs, points] and `trials` [runs]: each run's own curve, where it is shown.
    """

    agent: str
    environment: str
    value: str
    steps: np.ndarray
    x: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    num_runs: int
    runs: np.ndarray | None = None
    trials: Sequence[str] = ()


def checkpoints(steps: int, episode: int | None = None) -> np.ndarray:
    """Return the steps, of 1 … `steps`, where curves are read: the first of each `episode` where all have that length."""
    return thinned(np.arange(1, steps - (episode or 1) + 2, episode or 1))


def thinned(points: np.ndarray) -> np.ndarray:
    """Return MOST_POINTS of the points, evenly spaced, first and last among them; all where there are not more."""
    if len(points) <= MOST_POINTS:
        return points
    return points[np.unique(np.linspace(0, len(points) - 1, MOST_POINTS).round().astype(int))]


def read_at(steps: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the values [points] of a function of steps that changes at `steps` (ascending), NaN before the first."""
    index = np.searchsorted(steps, at, side="right") - 1
    return np.where(index >= 0, values[np.maximum(index, 0)], np.nan) if len(steps) else np.full(len(at), np.nan)


def run_curves(episodes: pd.DataFrame, trials: Sequence[str], at: np.ndarray, worst: float) -> np.ndarray:
    """Return each trial's curve [trials, points] from episodes (trial, first_step, episodic_return, ending), by the rules above.

    `worst`: what a diverged run counts as. A row of NaN is a run without a completed episode.
    """
    unfinished = (episodes["ending"] == "budget") & np.isfinite(episodes["episodic_return"])
    rows = episodes[~unfinished].sort_values(["trial", "first_step"])
    found = dict(iter(rows.groupby("trial", observed=True)))
    curves = np.full((len(trials), len(at)), np.nan)
    for row, trial in enumerate(trials):
        if trial in found:
            returns = found[trial]["episodic_return"].to_numpy(np.float64)
            returns = np.where(np.isfinite(returns), returns, worst)
            curves[row] = read_at(found[trial]["first_step"].to_numpy(), returns, at)
    return curves


def surround(
    kind: str, mean: np.ndarray, error: np.ndarray, num_runs: int, curves: Callable[[], np.ndarray], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends [points] of the band of a mean with its standard error; NaN for an interval of a single run.

    `curves` yields the runs' own [runs, points], for bands that need them.
    """
    nothing = np.full(len(mean), np.nan)
    if kind == "min-max":
        runs = curves()
        return runs.min(axis=0), runs.max(axis=0)
    if kind not in INTERVALS or num_runs < 2:
        return nothing, nothing
    if kind == "bootstrap":
        found = band(curves(), "percentile", resamples=RESAMPLES, seed=seed)
        return found.low, found.high
    half = error * (stats.t.ppf(0.975, num_runs - 1) if kind == "student" else 1.0)
    return mean - half, mean + half


def tidy(curves: Sequence[Curve]) -> pd.DataFrame:
    """Return a row for each point of each line, and, with an entry in `trial`, for each point of each run that is shown."""
    parts = []
    for curve in curves:
        line = {"agent": curve.agent, "environment": curve.environment, "line": curve.value or None}
        point = {"step": curve.steps, "x": curve.x}
        shown = {"mean": curve.mean, "low": curve.low, "high": curve.high, "num_runs": curve.num_runs}
        parts.append(pd.DataFrame({**line, **point, **shown}))
        if curve.runs is not None:
            parts += [
                pd.DataFrame({**line, **point, "trial": trial, "episodic_return": run})
                for trial, run in zip(curve.trials, curve.runs, strict=True)
            ]
    columns = ["agent", "environment", "line", "step", "x", "mean", "low", "high", "num_runs"]
    columns += ["trial", "episodic_return"] if any(curve.runs is not None for curve in curves) else []
    # columns of NULL alone have no type that concat could agree on
    return pd.concat([part.dropna(axis=1, how="all") for part in parts], ignore_index=True).reindex(columns=columns)
