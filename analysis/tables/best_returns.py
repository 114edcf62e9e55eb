"""The highest return of one episode on each environment, G*, by which the thesis' normalizer divides (6.2.1, Table 6.1)."""

import duckdb
import numpy as np
import pandas as pd

from analysis.figures.options import NoDataError, Options
from analysis.figures.query_text import quoted
from analysis.tables.table import Table

TAKES = ("environments",)
_SQL = """
-- One row per environment: the highest return of a completed episode of the study's tuning runs, and the run that reached it.
SELECT
    normalizer_constants.environment,
    normalizer_constants.best_return,
    trials.agent,
    trials.seed,
    trials.setting,
    normalizer_constants.best_trial AS trial,
    normalizer_constants.source
FROM normalizer_constants
LEFT JOIN trials ON trials.trial = normalizer_constants.best_trial
WHERE normalizer_constants.study = {study} AND normalizer_constants.normalizer = 'thesis'
ORDER BY normalizer_constants.environment
"""
_PROGRESS = """
SELECT environment, SUM(planned), SUM(finished + diverged)
FROM study_progress
WHERE study = ? AND stage = 'tune'
GROUP BY environment
"""


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies with tuning runs, those of several settings first."""
    rows = connection.execute(
        """
        SELECT study
        FROM study_trials
        WHERE stage = 'tune' AND status IN ('finished', 'diverged')
        GROUP BY study
        ORDER BY COUNT(DISTINCT setting) = 1, study
        """
    ).fetchall()
    return [row[0] for row in rows]


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """The highest return of one completed episode on each environment, over all agents, settings and tuning runs of the study,
    and the run that reached it (of several the one with the lowest hash). A last episode that the budget cut off does not count.
    It approximates the highest return that can be attained, G*; the thesis' normalizer is N(p) = 1 − (G* − p) / |G*|. It is
    that of the frozen selection, where there is one, so that later runs do not move the scale.
    """
    sql = _SQL.format(study=quoted(study))
    data = connection.execute(sql).df()
    wanted = [options.keeps("", environment) for environment in data["environment"]]
    data = data[np.array(wanted, bool)].reset_index(drop=True)
    if data["best_return"].isna().all():
        raise NoDataError(f'study "{study}" has no completed episode of a tuning run yet')
    return Table(data.drop(columns="source"), _notes(connection, study, data), sql)


def _notes(connection: duckdb.DuckDBPyConnection, study: str, data: pd.DataFrame) -> list[str]:
    progress = {
        environment: (int(planned), int(done)) for environment, planned, done in connection.execute(_PROGRESS, [study]).fetchall()
    }
    shown = [progress[environment] for environment in data["environment"] if environment in progress]
    lines = [f"study {study}: over {sum(done for _, done in shown):,} tuning runs of all agents and settings"]
    for environment, best, trial, source in data[["environment", "best_return", "trial", "source"]].itertuples(index=False):
        planned, done = progress.get(environment, (0, 0))
        if done < planned:
            lines.append(f"{environment}: {done:,} of {planned:,} tuning runs: G* may still rise")
        if pd.isna(best):
            lines.append(f"{environment}: no completed episode yet")
        elif best == 0:
            lines.append(
                f"{environment}: G* is 0, and the thesis' normalizer, which divides by |G*|, is undefined there; "
                'choose "minmax", "percentile" or "cdf"'
            )
        elif source == "selection" and pd.isna(trial):
            lines.append(f"{environment}: G* is that of the selection; the run that reached it is not in the store")
    return lines
