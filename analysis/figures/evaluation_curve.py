"""Deterministic evaluation beside the learning (thesis chapter 3, Figures 3.1 to 3.3)."""

from collections.abc import Callable

import duckdb
import numpy as np
import pandas as pd

from analysis.figures import curve_data, curve_runs, every_setting, style
from analysis.figures.curve_data import Curve
from analysis.figures.curve_panels import draw_panels
from analysis.figures.curve_runs import CurveRuns, between
from analysis.figures.drawing import Drawing
from analysis.figures.options import NoDataError, Options
from analysis.figures.query_text import listed

TAKES = ("by", "agents", "environments", "band")
MOST_SETTINGS = 6
"""Settings of an agent on an environment that are all drawn; of more, the chosen one."""
_EVALUATIONS = """
-- One row per (trial, step): the mean return of the deterministic episodes there; NULL from where on the run had diverged.
SELECT
    trial,
    step,
    CASE WHEN BOOL_AND(ISFINITE(episodic_return)) THEN AVG(CAST(episodic_return AS DOUBLE)) END AS episodic_return
FROM evaluations
WHERE trial IN ({trials})
GROUP BY trial, step
ORDER BY trial, step
"""
_EPISODES = """
-- One row per episode of the runs that are shown, by run.
SELECT trial, episode, first_step, length, episodic_return, ending
FROM episodes
WHERE trial IN ({trials})
ORDER BY trial, episode
"""


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies that evaluate beside the learning; where there are none, all that have runs."""
    evaluated = {
        row[0]
        for row in connection.execute(
            "SELECT DISTINCT study FROM members WHERE trial IN (SELECT DISTINCT trial FROM evaluations)"
        ).fetchall()
    }
    known = [study for study in curve_runs.studies(connection, options) if every_setting.matches(connection, study, options)]
    return [study for study in known if study in evaluated] or (known if _may_show_learning(options) else [])


def draw(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Drawing:
    """Average return of deterministic episodes, played beside the learning without exploration, by steps of learning: a panel
    for each environment and a line for each agent, or for each of its settings where it has a few and none was chosen. Lines are
    means over runs; the heading says what surrounds them and how many runs there are. Where it says that runs were chosen for
    their returns, the others are left out, which shows how far luck goes and nothing else. Several episodes of a run at one
    step are averaged first. A run that diverged is left out from then on, which makes a mean too good. The figures of chapter 3
    show a study without such episodes by its learning curves, and the heading says so. At most 500 points are shown.
    """
    shown = _shown_runs(connection, study, options)
    kind = options.band or "standard-error"
    trials = listed(shown.finished["trial"])
    sql = _EVALUATIONS.format(trials=trials)
    rows = connection.execute(sql).df()
    is_evaluated = not rows.empty
    if is_evaluated:
        read = _evaluations(rows)
    elif not _may_show_learning(options):
        raise NoDataError(
            f'study "{study}" has no evaluation episodes (`evaluation` in [study] asks for them): see learning-curve'
        )
    else:
        sql = _EPISODES.format(trials=trials)
        read = _learning(connection, shown, connection.execute(sql).df())
    curves, counts = _curves(shown, read, kind, options)
    if not curves:
        raise NoDataError(f'study "{study}": no run has a finite return yet')
    subtitle = _subtitle(shown, curves, counts, kind, is_evaluated)
    with style.styled():
        figure = draw_panels(
            curves,
            shown.environments,
            dict.fromkeys(shown.environments, "Environment steps"),
            y_label="Average evaluation return" if is_evaluated else "Average episodic return",
            values=shown.values,
        )
        style.headline(figure, options.title, subtitle)
    return Drawing(figure, curve_data.tidy(curves), _notes(shown, curves, subtitle, is_evaluated), sql)


def _may_show_learning(options: Options) -> bool:
    """Return whether this is a figure of chapter 3, which says of which settings: those can do with learning curves."""
    return bool(options.where)


def _shown_runs(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> CurveRuns:
    """Return the evaluation runs of chosen settings where there are any, else the runs of every setting, if these are few."""
    stages = connection.execute(
        "SELECT DISTINCT stage FROM study_trials WHERE study = ? AND status IN ('finished', 'diverged')", [study]
    ).fetchall()
    if ("evaluate",) not in stages and options.by is None:
        shown = every_setting.load(connection, study, options)
        if shown.runs.groupby(["agent", "environment"])["setting"].nunique().max() <= MOST_SETTINGS:
            return shown
    return every_setting.only_where(connection, curve_runs.load(connection, study, options), options)


Reader = Callable[[str, list[str]], tuple[np.ndarray, np.ndarray]]
"""Environment and trials → steps [points] and each run's curve [runs, points], NaN where it has no finite return."""


def _evaluations(rows: pd.DataFrame) -> Reader:
    table = rows.pivot(index="trial", columns="step", values="episodic_return")

    def read(environment: str, trials: list[str]) -> tuple[np.ndarray, np.ndarray]:
        here = table.reindex(trials).dropna(axis=1, how="all")
        steps = curve_data.thinned(here.columns.to_numpy())
        return steps, here[steps].to_numpy(np.float64)

    return read


def _learning(connection: duckdb.DuckDBPyConnection, shown: CurveRuns, episodes: pd.DataFrame) -> Reader:
    worst = dict(
        connection.execute("SELECT environment, worst_return FROM worst_returns WHERE study = ?", [shown.study]).fetchall()
    )

    def read(environment: str, trials: list[str]) -> tuple[np.ndarray, np.ndarray]:
        at = curve_data.checkpoints(shown.steps[environment])
        own = episodes[episodes["trial"].isin(trials)]
        return at, curve_data.run_curves(own, trials, at, worst.get(environment, np.nan))

    return read


def _curves(shown: CurveRuns, read: Reader, kind: str, options: Options) -> tuple[list[Curve], list[int]]:
    """Return the lines, and how many runs each would have if none were left out for its returns."""
    curves, counts = [], []
    for (environment, agent, _, value), group in shown.finished.groupby(["environment", "agent", "rank", "value"]):
        trials = list(group["trial"])
        steps, runs = read(str(environment), trials)
        some = np.flatnonzero(np.isfinite(runs).any(axis=1))
        if not len(some):
            continue
        trials, runs = [trials[index] for index in some], runs[some]
        counts.append(len(trials))
        if options.best_runs is not None:
            best = np.sort(np.argsort(-np.nanmean(runs, axis=1), kind="stable")[: options.best_runs])
            trials, runs = [trials[index] for index in best], runs[best]
        mean, low, high = _summary(runs, kind, options.seed)
        curves.append(
            Curve(
                agent=str(agent),
                environment=str(environment),
                value=str(value),
                steps=steps,
                x=steps,
                mean=mean,
                low=low,
                high=high,
                num_runs=len(trials),
                runs=runs if kind == "runs" else None,
                trials=trials,
            )
        )
    return curves, counts


def _summary(runs: np.ndarray, kind: str, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean, low and high [points] of runs [runs, points], at each point of the runs that are finite there."""
    mean, low, high = (np.full(runs.shape[1], np.nan) for _ in range(3))
    finite = np.isfinite(runs)
    for pattern in np.unique(finite, axis=1).T:  # runs diverge one by one, so that there are few patterns
        points = (finite == pattern[:, None]).all(axis=0)
        here = runs[pattern][:, points]
        if len(here):
            mean[points] = here.mean(axis=0)
            error = here.std(axis=0, ddof=1) / np.sqrt(len(here)) if len(here) > 1 else np.full(here.shape[1], np.nan)
            low[points], high[points] = curve_data.surround(kind, mean[points], error, len(here), here.view, seed)
    return mean, low, high


def _subtitle(shown: CurveRuns, curves: list[Curve], counts: list[int], kind: str, is_evaluated: bool) -> str:
    """Return n, steps, kind of interval, stage; and what was chosen."""
    most = max(curve.num_runs for curve in curves)
    shown_counts = between(curve.num_runs for curve in curves)
    runs = shown.kind_of_runs() if max(counts) > 1 else shown.kind_of_runs().removesuffix("s")
    what = curve_data.BANDS[kind] if most > 1 or kind not in curve_data.INTERVALS else "a single run, no interval"
    number = f"{shown_counts} {runs} a line"
    if any(curve.num_runs < count for curve, count in zip(curves, counts, strict=True)):
        number = f"{shown_counts} of {between(counts)} {runs} a line, chosen for their returns"
    number += ", by which the settings were chosen" if shown.is_biased else ""
    parts = [what, f"{number}, {shown.steps_text()}"]
    parts += [shown.tuned()] if shown.is_choice else []
    parts += [] if is_evaluated else ["learning curves, for want of deterministic evaluations"]
    return "; ".join(parts)


def _notes(shown: CurveRuns, curves: list[Curve], subtitle: str, is_evaluated: bool) -> list[str]:
    """Return lines: what is shown, what is missing, and where each line ends."""
    lines = [f"study {shown.study}: {subtitle}"]
    if not is_evaluated:
        lines.append(
            'the study has no deterministic evaluations ("evaluation" in its grid); its learning curves are shown by step'
        )
    then = "left out from then on: the mean is too good" if is_evaluated else "counted as the worst return from then on"
    lines += shown.notes(then)
    for curve in curves:
        last = f"{shown.line(curve.agent, curve.value)} on {curve.environment}: {curve.mean[-1]:.4g} at the end"
        if np.isfinite(curve.low[-1]):
            last += f" ({curve.low[-1]:.4g} to {curve.high[-1]:.4g})"
        lines.append(f"{last}, n = {curve.num_runs}")
    return lines
