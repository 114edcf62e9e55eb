"""The chosen settings: tuned across environments (thesis Table A.1) and per environment (Tables A.2 to A.4)."""

import math
from collections.abc import Hashable, Mapping
from typing import Any

import duckdb
import numpy as np
import pandas as pd

from analysis.figures.curve_runs import kept
from analysis.figures.options import REGIMES, NoDataError, Options
from analysis.figures.query_text import quoted
from analysis.tables.table import Table
from analysis.tuning_scale import find_normalizer, normalize
from sweep.messages import UserError

Row = Mapping[Hashable, Any]
TAKES = ("by", "agents", "environments")
_FIRST = ("actor_step_size_scale", "critic_step_size", "entropy_scale")  # as the thesis' tables have them
_PER_ENVIRONMENT = """
-- One row per (agent, environment, for_each): the chosen setting, and its mean scores over the tuning and the evaluation runs.
SELECT
    tuned.agent,
    tuned.environment,
    tuned.for_each,
    {hypers}
    tuned.mean,
    tuned.standard_error,
    tuned.num_seeds,
    evaluated.mean AS evaluation_mean,
    evaluated.standard_error AS evaluation_standard_error,
    evaluated.num_seeds AS num_evaluation_seeds,
    tuned.runner_up_mean,
    tuned.setting,
    tuned.score,
    tuned.source,
    tuned.num_settings,
    tuned.num_left_out,
    tuned.num_tied,
    tuned.on_edge
FROM tuned_per_environment AS tuned
LEFT JOIN setting_scores AS evaluated
    ON evaluated.study = tuned.study
    AND evaluated.stage = 'evaluate'
    AND evaluated.agent = tuned.agent
    AND evaluated.environment = tuned.environment
    AND evaluated.setting = tuned.setting
WHERE tuned.study = {study}
ORDER BY tuned.agent, tuned.environment, tuned.for_each
"""
_ACROSS = """
-- One row per (agent, for_each): the hyperparameters that were chosen for all environments, with their normalized tuning score.
SELECT
    agent,
    for_each,
    {hypers}
    ANY_VALUE(normalized) AS normalized,
    ANY_VALUE(num_seeds) AS num_seeds,
    ANY_VALUE(runner_up_normalized) AS runner_up_normalized,
    COUNT(*) AS num_environments,
    ANY_VALUE(score) AS score,
    ANY_VALUE(normalizer) AS normalizer,
    ANY_VALUE(source) AS source,
    ANY_VALUE(num_settings) AS num_settings,
    ANY_VALUE(num_left_out) AS num_left_out,
    ANY_VALUE(num_tied) AS num_tied,
    LIST_SORT(LIST_DISTINCT(FLATTEN(LIST(on_edge)))) AS on_edge,
    LIST(environment ORDER BY environment) AS environments,
    LIST(setting ORDER BY environment) AS settings
FROM tuned_across_environments
WHERE study = {study}
GROUP BY agent, for_each
ORDER BY agent, for_each
"""
_BEHIND = ["score", "normalizer", "source", "num_settings", "num_left_out", "num_tied", "on_edge", "environments", "settings"]
"""Columns that only the notes need."""
_SCORED = ("standard_error", "evaluation_normalized", "evaluation_standard_error", "num_evaluation_seeds")
"""Columns of a choice across environments that are computed here."""


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies that have chosen settings, those with a frozen selection first."""
    view = f"tuned_{(options.by or REGIMES[0]).replace('-', '_')}"
    rows = connection.execute(
        f"SELECT study, agent, environment, is_frozen, num_settings FROM {view} ORDER BY NOT is_frozen, num_settings = 1, study"
    ).fetchall()
    found = list(dict.fromkeys(study for study, agent, environment, *_ in rows if options.keeps(agent, environment)))
    if found or options.by != REGIMES[1]:
        return found
    planned = [row[0] for row in connection.execute("SELECT DISTINCT study FROM members ORDER BY study").fetchall()]
    return [study for study in planned if _undefined(connection, study)]  # so that it says why


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """The chosen settings: the values of the hyperparameters that were swept, NULL where one does not apply on the environment;
    κ is actor_step_size_scale. Tuned per environment: for each environment the setting with the highest mean score over the
    tuning runs, with that mean, its standard error and number of runs, the same of the evaluation runs, whose seeds had no part
    in the choice, and the tuning mean of the runner-up. The tuning mean is too high, as a maximum is; the evaluation mean
    is not. Tuned across environments: the hyperparameters with the highest normalized score, averaged over runs and then
    environments, and that score on the evaluation runs; its standard error is over seeds, which environments share.
    """
    by = options.by or REGIMES[0]
    swept = _swept(connection, study, options)
    if by == REGIMES[0]:
        return _per_environment(connection, study, options, swept)
    return _across(connection, study, options, swept)


def _swept(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> list[str]:
    """Return the hyperparameters in which settings differ, in the thesis' order and then by name."""
    rows = connection.execute(
        "SELECT DISTINCT agent, environment, hyperparameter FROM hyperparameters WHERE study = ? AND is_swept", [study]
    ).fetchall()
    names = {name for agent, environment, name in rows if options.keeps(agent, environment)}
    return [name for name in _FIRST if name in names] + sorted(names.difference(_FIRST))


def _per_environment(connection: duckdb.DuckDBPyConnection, study: str, options: Options, swept: list[str]) -> Table:
    hypers = "".join(f'tuned."{name}",\n    ' for name in swept)
    sql = _PER_ENVIRONMENT.format(study=quoted(study), hypers=hypers.rstrip())
    data = connection.execute(sql).df()
    data = kept(data, options).reset_index(drop=True)
    if data.empty:
        raise NoDataError(_nothing(study))
    notes = [_about(study, REGIMES[0], data)]
    if data["num_evaluation_seeds"].isna().all() and (data["num_settings"] > 1).any():
        notes.append("no evaluation runs: the means are of the runs that the settings were chosen by, and too high")
    for row in data.to_dict("records"):
        notes += _row_notes(f"{row['agent']} on {row['environment']}" + _chosen_for(row), row)
    notes += _divergence(
        connection, study, [(row["agent"], row["environment"], row["setting"]) for row in data.to_dict("records")]
    )
    return Table(_shown(data), notes, sql)


def _across(connection: duckdb.DuckDBPyConnection, study: str, options: Options, swept: list[str]) -> Table:
    hypers = "".join(f'ANY_VALUE("{name}") AS "{name}",\n    ' for name in swept)
    sql = _ACROSS.format(study=quoted(study), hypers=hypers.rstrip())
    data = connection.execute(sql).df()
    wanted = [
        any(options.keeps(agent, environment) for environment in environments)
        for agent, environments in zip(data["agent"], data["environments"], strict=True)
    ]
    data = data[np.array(wanted, bool)].reset_index(drop=True)
    if data.empty:
        raise NoDataError(_undefined(connection, study) or _nothing(study))
    notes = [_about(study, REGIMES[1], data)]
    found: dict[str, list[float | None]] = {name: [] for name in _SCORED}
    for row in data.to_dict("records"):
        where = f"{row['agent']}{_chosen_for(row)}"
        try:
            tuning, evaluation = (_normalized(connection, study, row, stage) for stage in ("tune", "evaluate"))
        except UserError as error:
            notes.append(f"{where}: {error}")
            tuning = evaluation = np.array([])
        values = (_error(tuning), _mean(evaluation), _error(evaluation), len(evaluation) or None)
        for name, value in zip(_SCORED, values, strict=True):
            found[name].append(value)
        notes += _row_notes(where, row)
    chosen = [
        (row["agent"], *place)
        for row in data.to_dict("records")
        for place in zip(row["environments"], row["settings"], strict=True)
    ]
    notes += _divergence(connection, study, chosen)
    if not any(found["num_evaluation_seeds"]) and (data["num_settings"] > 1).any():
        notes.insert(1, "no evaluation runs: the scores are of the runs that the settings were chosen by, and too high")
    scored = pd.DataFrame(found, dtype="Float64")
    order = list(data.columns)
    after = order.index("normalized") + 1
    data = pd.concat([data, scored], axis=1)[[*order[:after], "standard_error", order[after], *_SCORED[1:], *order[after + 1 :]]]
    return Table(_shown(data), notes, sql)


def _normalized(connection: duckdb.DuckDBPyConnection, study: str, row: Row, stage: str) -> np.ndarray:
    """Return the normalized score of each seed, averaged over the environments of a choice; of seeds that all of them have."""
    environments = list(row["environments"])
    settings = dict(zip(environments, row["settings"], strict=True))
    runs = connection.execute(
        """
        SELECT environment, setting, seed, score
        FROM run_scores
        WHERE study = ? AND stage = ? AND agent = ? AND score IS NOT NULL
        """,
        [study, stage, row["agent"]],
    ).df()
    runs = runs[runs["setting"] == runs["environment"].map(settings)]
    scale, _, _ = find_normalizer(connection, study, str(row["score"]), str(row["normalizer"]), environments)
    table = runs.pivot(index="seed", columns="environment", values="score").reindex(environments, axis=1).dropna()
    columns = [normalize(scale, environment, table[environment].to_numpy(np.float64)) for environment in environments]
    return np.mean(columns, axis=0) if len(table) else np.array([])


def _mean(scores: np.ndarray) -> float | None:
    return math.fsum(scores) / len(scores) if len(scores) else None


def _error(scores: np.ndarray) -> float | None:
    return float(np.std(scores, ddof=1) / math.sqrt(len(scores))) if len(scores) > 1 else None


def _shown(data: pd.DataFrame) -> pd.DataFrame:
    """Return the columns that a reader wants, numbers of runs as whole numbers."""
    data = data.drop(columns=[name for name in _BEHIND if name in data.columns])
    if (data["for_each"] == "{}").all():
        data = data.drop(columns="for_each")
    return data.astype({name: "Int64" for name in data.columns if name.startswith("num_")})


def _about(study: str, by: str, data: pd.DataFrame) -> str:
    scores, sources = sorted(data["score"].unique()), set(data["source"])
    chosen = "frozen selection" if sources == {"selection"} else "computed from the tuning runs there are now"
    normalizer = f", normalizer {data['normalizer'].iloc[0]}" if "normalizer" in data.columns else ""
    return f"study {study}: tuned {by.replace('-', ' ')} by {', '.join(scores)}{normalizer}; {chosen}"


def _row_notes(where: str, row: Row) -> list[str]:
    lines = []
    edges = [] if row["on_edge"] is None else list(row["on_edge"])
    if edges:
        ends = "is at an end" if len(edges) == 1 else "are at the ends"
        lines.append(f"{where}: {' and '.join(edges)} {ends} of the values that were swept: something better may lie beyond")
    others, left_out = int(row["num_tied"]), int(row["num_left_out"])
    if others > 0:
        settings = "setting is" if others == 1 else "settings are"
        lines.append(f"{where}: {others:,} other {settings} exactly as good; the lowest hash was chosen")
    if left_out:
        lines.append(
            f"{where}: {left_out:,} {'setting' if left_out == 1 else 'settings'} left out, for want of runs with a score"
        )
    if row["num_settings"] == 1:
        lines.append(f"{where}: one setting, nothing to choose from")
    return lines


def _divergence(connection: duckdb.DuckDBPyConnection, study: str, chosen: list[tuple[str, str, str]]) -> list[str]:
    """Return a line for each chosen setting (agent, environment, setting) of which runs diverged: its score is no performance."""
    rows = connection.execute(
        """
        SELECT agent, environment, setting, stage, num_diverged, num_planned
        FROM settings
        WHERE study = ? AND num_diverged > 0
        ORDER BY agent, environment, stage DESC
        """,
        [study],
    ).fetchall()
    stages = {"tune": "tuning", "evaluate": "evaluation"}
    return [
        f"{agent} on {environment}: {diverged} of {planned} {stages[stage]} runs of the chosen setting diverged"
        + ("; its score says nothing" if diverged == planned else "")
        for agent, environment, setting, stage, diverged, planned in rows
        if (agent, environment, setting) in set(chosen)
    ]


def _chosen_for(row: Row) -> str:
    return "" if row["for_each"] == "{}" else f" for {row['for_each']}"


def _undefined(connection: duckdb.DuckDBPyConnection, study: str) -> str:
    """Return on which environment scores across environments are undefined by the study's normalizer; "" where on none."""
    row = connection.execute(
        """
        SELECT STRING_AGG(environment, ', ' ORDER BY environment), ANY_VALUE(normalizer)
        FROM normalizer_constants
        INNER JOIN study_rules USING (study, normalizer)
        WHERE study = ? AND (best_return = 0 OR low = high)
        """,
        [study],
    ).fetchone()
    if row is None or row[0] is None:
        return ""
    why = "G* is 0" if row[1] == "thesis" else "settings do not differ"
    return (
        f'study "{study}": normalizer "{row[1]}" is undefined on {row[0]}, where {why}: nothing can be chosen across environments'
    )


def _nothing(study: str) -> str:
    return f'study "{study}" has no setting yet that could be chosen: one is compared once all its tuning runs are there'
