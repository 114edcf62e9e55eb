"""Runs of every setting of a study, for figures of studies that compare a few settings and choose none."""

import duckdb
import numpy as np
import pandas as pd

from analysis.figures import style
from analysis.figures.curve_runs import CurveRuns, kept, nothing, planned_steps, short
from analysis.figures.options import NoDataError, Options

_RUNS = """
SELECT agent, environment, '{}' AS for_each, trial, stage, setting, seed, status
FROM study_trials
WHERE study = ? AND stage = 'tune'
ORDER BY agent, environment, setting, seed, trial
"""
_HYPERS = "SELECT DISTINCT agent, setting, hyperparameter, number, value FROM hyperparameters WHERE study = ?"


def load(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> CurveRuns:
    """Return the tuning runs of every setting that the options ask for; lines are named by what tells an agent's settings apart.

    Raises NoDataError where there are none.
    """
    runs = connection.execute(_RUNS, [study]).df()
    runs = kept(runs, options)
    if not runs["status"].isin(["finished", "diverged"]).any():
        raise NoDataError(nothing(connection, study, options))
    shown = CurveRuns(study, "", runs.assign(value="", rank=0), "", planned_steps(connection, study, runs), False, None)
    return only_where(connection, shown, options)


def matches(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> bool:
    """Return whether any setting of the study has all that `where` asks for."""
    if not options.where:
        return True
    known = _hypers(connection, study)
    return any(all(name in row and _equal(row[name], value) for name, value in options.where.items()) for row in known.values())


def only_where(connection: duckdb.DuckDBPyConnection, shown: CurveRuns, options: Options) -> CurveRuns:
    """Return the runs of settings that have what `where` asks for, if they have the hyperparameter at all.

    Raises NoDataError where no setting has it.
    """
    known = _hypers(connection, shown.study)
    asked = ", ".join(f"{name} = {short(value)}" for name, value in options.where.items())
    if not matches(connection, shown.study, options):
        raise NoDataError(f'study "{shown.study}" has no setting with {asked}')

    def keeps(agent: str, setting: str) -> bool:
        row = known[agent, setting]
        return all(name not in row or _equal(row[name], value) for name, value in options.where.items())

    places = zip(shown.runs["agent"], shown.runs["setting"], strict=True)
    runs = shown.runs[np.fromiter((keeps(*place) for place in places), bool, len(shown.runs))].reset_index(drop=True)
    if not runs["status"].isin(["finished", "diverged"]).any():
        raise NoDataError(f'study "{shown.study}" has no run of a setting with {asked} yet')
    if shown.by == "":
        runs = _named(runs, known)
    return CurveRuns(shown.study, shown.by, runs, shown.values, shown.steps, shown.is_choice, shown.normalizer)


def _hypers(connection: duckdb.DuckDBPyConnection, study: str) -> dict[tuple[str, str], dict[str, object]]:
    """Return agent and setting → hyperparameter → value."""
    found: dict[tuple[str, str], dict[str, object]] = {}
    for agent, setting, name, number, text in connection.execute(_HYPERS, [study]).fetchall():
        found.setdefault((agent, setting), {})[name] = text if number is None else number
    return found


def _named(runs: pd.DataFrame, known: dict[tuple[str, str], dict[str, object]]) -> pd.DataFrame:
    """Give each line its value: the hyperparameter that alone tells the agent's settings apart, or else all that differ."""
    values: dict[tuple[str, str], tuple[int, str]] = {}
    for agent, group in runs.groupby("agent"):
        settings = {setting: known[str(agent), setting] for setting in sorted(group["setting"].unique())}
        names = sorted({name for row in settings.values() for name in row})
        kinds = {name: {short(row.get(name)) for row in settings.values()} for name in names}
        differing = [name for name in names if len(kinds[name]) > 1]
        alone = [name for name in differing if len(kinds[name]) == len(settings)]
        telling = (
            [min(alone, key=lambda name: (isinstance(next(iter(settings.values()))[name], float), name))] if alone else differing
        )
        texts = {
            setting: ", ".join(f"{style.words(name).lower()} {short(row[name])}" for name in telling if name in row)
            for setting, row in settings.items()
        }
        order = sorted(texts, key=lambda setting: [str(settings[setting].get(name, "")) for name in telling])
        values |= {(str(agent), setting): (order.index(setting), texts[setting]) for setting in order}
    pairs = [values[pair] for pair in zip(runs["agent"], runs["setting"], strict=True)]
    return runs.assign(rank=[rank for rank, _ in pairs], value=[text for _, text in pairs])


def _equal(known: object, asked: object) -> bool:
    return known == asked or str(known) == str(asked)
