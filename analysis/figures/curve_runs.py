"""The runs whose curves a figure shows, sorted into its lines: those of the settings that a study chose, or of every setting.

Lines are agents, and within an agent the values of the hyperparameters for each of which a setting was chosen.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import duckdb
import numpy as np
import pandas as pd

from analysis.figures import style
from analysis.figures.options import REGIMES, NoDataError, Options
from sweep.messages import suggestion

_RUNS = """
SELECT agent, environment, for_each, trial, stage, setting, seed, status
FROM chosen_runs
WHERE study = ? AND "by" = ?
ORDER BY agent, environment, for_each, seed, trial
"""
_CHOICES = """
SELECT agent, environment, for_each, setting, num_settings
FROM tuned_{by}
WHERE study = ?
"""


@dataclass(frozen=True)
class CurveRuns:
    """The runs of a study that a figure shows.

    `runs` has a row per run: agent, environment, for_each, value (of the line, as text; "" where agents have one line each),
    rank (the value's place), trial, stage, setting, seed, status. `values`: what the values are of, in words. `steps`: by
    environment. `by`: the rule that chose the settings, "" where every setting is shown. `is_choice`: whether any of them was
    one of several. `normalizer`: that of a choice across environments.
    """

    study: str
    by: str
    runs: pd.DataFrame
    values: str
    steps: dict[str, int]
    is_choice: bool
    normalizer: str | None

    @property
    def finished(self) -> pd.DataFrame:
        """The runs that are in the store, diverged ones among them."""
        return self.runs[self.runs["status"].isin(["finished", "diverged"])]

    @property
    def environments(self) -> list[str]:
        """Environments in alphabetical order."""
        return sorted(self.runs["environment"].unique())

    @property
    def stages(self) -> list[str]:
        """Stages that the runs are of."""
        return sorted(self.runs["stage"].unique())

    @property
    def is_biased(self) -> bool:
        """Whether settings are shown by the runs that they were chosen by."""
        return self.is_choice and "tune" in self.stages

    def line(self, agent: str, value: str) -> str:
        """Return a line in words: `GreedyAC`, or `GreedyAC, Action samples N 10`."""
        return ", ".join(part for part in (agent, f"{self.values} {value}".strip() if value else "") if part)

    def tuned(self) -> str:
        """Return the rule in words."""
        return "tuned per environment" if self.by == REGIMES[0] else f"tuned across environments ({self.normalizer} normalizer)"

    def steps_text(self) -> str:
        """Return "30,000 steps", or from how many to how many where environments differ."""
        return f"{between(self.steps.values())} steps"

    def kind_of_runs(self) -> str:
        """Return "evaluation runs" or "tuning runs"."""
        return "tuning runs" if "tune" in self.stages else "evaluation runs"

    def notes(self, then: str = "counted as the worst return of the environment from then on") -> list[str]:
        """Return lines: a warning where settings are shown by the runs they were chosen by; runs that are missing or diverged.

        `then`: what becomes of a run that diverged.
        """
        lines = []
        if self.is_biased:
            lines.append(
                "warning: no evaluation runs; these are the tuning runs that the settings were chosen by: biased upwards"
            )
        for (agent, environment, _, value), group in self.runs.groupby(["agent", "environment", "rank", "value"], sort=True):
            where = f"{self.line(str(agent), str(value))} on {environment}"
            there = int(group["status"].isin(["finished", "diverged"]).sum())
            if there < len(group):
                lines.append(f"{where}: {there:,} of {len(group):,} runs")
            if diverged := int((group["status"] == "diverged").sum()):
                lines.append(f"{where}: {diverged:,} diverged, {then}")
        return lines


def regimes(connection: duckdb.DuckDBPyConnection, study: str) -> list[str]:
    """Return the rules by which the study chooses (view `study_rules`): it evaluates no others."""
    row = connection.execute('SELECT "by" FROM study_rules WHERE study = ?', [study]).fetchone()
    return [by for by in REGIMES if row and by in row[0]] or list(REGIMES)


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies that have runs of chosen settings; with `over`, those that choose for each of several of its values.

    Where none does, those whose settings differ in it. Raises NoDataError where no study has such a hyperparameter.
    """
    rows = connection.execute(
        """
        SELECT DISTINCT study, agent, environment
        FROM study_trials
        WHERE status IN ('finished', 'diverged')
        ORDER BY study
        """
    ).fetchall()
    found = list(dict.fromkeys(study for study, *place in rows if options.keeps(*place)))
    found = [study for study in found if options.by is None or options.by in regimes(connection, study)]
    if options.over is None:
        return found
    chosen_for = connection.execute(
        "SELECT study FROM selections GROUP BY study HAVING COUNT(DISTINCT for_each ->> ?) > 1", [options.over]
    ).fetchall()
    differing: dict[str, set[str]] = {}
    for study, agent, environment, value in _known_values(connection, options.over):
        if options.keeps(agent, environment):
            differing.setdefault(study, set()).add(value)
    several = [study for study in found if len(differing.get(study, ())) > 1]
    return [study for study in found if (study,) in chosen_for] or several


def _known_values(connection: duckdb.DuckDBPyConnection, name: str) -> list[tuple[str, str, str, str]]:
    """Return study, agent, environment and value, as text, of a hyperparameter. Raises NoDataError where nothing has it."""
    rows = connection.execute(
        "SELECT DISTINCT study, agent, environment, value FROM hyperparameters WHERE hyperparameter = ?", [name]
    ).fetchall()
    known = [] if rows else connection.execute("SELECT DISTINCT hyperparameter FROM hyperparameters").fetchall()
    if known:
        raise NoDataError(f'--over: unknown hyperparameter "{name}": {suggestion(name, [row[0] for row in known])}')
    return rows


def load(connection: duckdb.DuckDBPyConnection, study: str, options: Options, by: str | None = None) -> CurveRuns:
    """Return the runs of chosen settings that the options ask for.

    Raises NoDataError where there are none, and for an `over` that no setting has.
    """
    known = regimes(connection, study)
    by = by or options.by or known[0]
    if by not in known:
        raise NoDataError(f'study "{study}" has chosen no settings {by}; it chose them {", ".join(known)}')
    runs = connection.execute(_RUNS, [study, by]).df()
    runs = kept(runs, options)
    if not runs["status"].isin(["finished", "diverged"]).any():
        raise NoDataError(nothing(connection, study, options))
    choices = connection.execute(_CHOICES.format(by=by.replace("-", "_")), [study]).df()
    runs, values = _with_values(connection, study, options.over, runs)
    rules = connection.execute("SELECT normalizer FROM study_rules WHERE study = ?", [study]).fetchone()
    shown = runs[["agent", "environment", "for_each", "setting"]].drop_duplicates().merge(choices)
    return CurveRuns(
        study=study,
        by=by,
        runs=runs.reset_index(drop=True),
        values=values,
        steps=planned_steps(connection, study, runs),
        is_choice=bool((shown["num_settings"] > 1).any()),
        normalizer=rules[0] if rules and by == REGIMES[1] else None,
    )


def kept(rows: pd.DataFrame, options: Options) -> pd.DataFrame:
    """Return the rows whose `agent` and `environment` the options ask for."""
    places = zip(rows["agent"], rows["environment"], strict=True)
    return rows[np.fromiter((options.keeps(*place) for place in places), bool, len(rows))]


def planned_steps(connection: duckdb.DuckDBPyConnection, study: str, runs: pd.DataFrame) -> dict[str, int]:
    """Return the steps of a trial on each environment of the runs."""
    rows = connection.execute("SELECT environment, MAX(steps) FROM members WHERE study = ? GROUP BY ALL", [study]).fetchall()
    return {environment: steps for environment, steps in rows if environment in set(runs["environment"])}


def between(counts: Iterable[int]) -> str:
    """Return a count, or the lowest and the highest where they differ: `30`, `28 to 30`."""
    known = sorted(set(counts))
    return f"{known[0]:,}" if len(known) == 1 else f"{known[0]:,} to {known[-1]:,}"


def nothing(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> str:
    """Return why there is nothing to show."""
    rows = connection.execute("SELECT DISTINCT agent, environment FROM members WHERE study = ? ORDER BY ALL", [study]).fetchall()
    if rows and not any(options.keeps(*row) for row in rows):
        known = [", ".join(sorted({row[place] for row in rows})) for place in (0, 1)]
        return f'study "{study}" has no such agent on such an environment; it has {known[0]} on {known[1]}'
    return (
        f'study "{study}" has no runs of chosen settings yet: a setting is compared once all its tuning runs are there; '
        "`sweep launch` trains them"
    )


def _with_values(
    connection: duckdb.DuckDBPyConnection, study: str, over: str | None, runs: pd.DataFrame
) -> tuple[pd.DataFrame, str]:
    """Add `value` and `rank` to runs, and return what the values are of."""
    chosen_for = [json.loads(text) for text in runs["for_each"]]
    names = list(dict.fromkeys(name for known in chosen_for for name in known))
    if over is not None and over not in names:
        column = _column(connection, study, over)
        key = ["agent", "environment", "setting"]
        chosen_for = [
            {over: column.get(tuple(row)), **known} for row, known in zip(runs[key].to_numpy(), chosen_for, strict=True)
        ]
        names = [over, *names]
    texts = [
        ", ".join(
            short(known[name]) if len(names) == 1 else f"{style.words(name)} {short(known[name])}"
            for name in names
            if name in known
        )
        for known in chosen_for
    ]
    order = sorted({tuple(_sortable(known.get(name)) for name in names) for known in chosen_for})
    ranks = [order.index(tuple(_sortable(known.get(name)) for name in names)) for known in chosen_for]
    if over is not None and len(order) < 2:
        raise NoDataError(
            f'study "{study}" shows one {over} only; lines by its values need a choice for each: [select] for_each = ["{over}"]'
        )
    return runs.assign(value=texts, rank=ranks), style.words(names[0]) if len(names) == 1 else ""


def _column(connection: duckdb.DuckDBPyConnection, study: str, name: str) -> dict[tuple[str, str, str], Any]:
    """Return the value of a hyperparameter by agent, environment and setting."""
    rows = connection.execute(
        "SELECT agent, environment, setting, hyperparameter, number, value FROM hyperparameters WHERE study = ?", [study]
    ).fetchall()
    known = {row[3] for row in rows}
    if name not in known:
        raise NoDataError(f'--over: unknown hyperparameter "{name}": {suggestion(name, known)}')
    return {
        (agent, environment, setting): text if number is None else number
        for agent, environment, setting, hyper, number, text in rows
        if hyper == name
    }


def short(value: Any) -> str:
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)


def _sortable(value: Any) -> tuple[int, float, str]:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return (0, float(value), "") if is_number else (1, 0.0, str(value))
