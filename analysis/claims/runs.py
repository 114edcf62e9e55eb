"""The runs that tests are about: their mean returns in parts of the steps, and the scores behind a sensitivity region."""

from collections.abc import Iterable

import duckdb
import numpy as np
import pandas as pd

from analysis.claims.claims import Side
from analysis.figures import sensitivity_data
from analysis.figures.options import NoDataError, Options
from analysis.figures.query_text import quoted

Window = tuple[float, float]
_WINDOW_MEANS = """
-- One row per run and window, a part of its steps from `low` to `high`: the mean return there, each step with the return of its
-- episode. Completed episodes count; a diverged run has the worst return of the environment. Runs are those of the evaluation
-- stage where the study has one.
WITH known AS (
    SELECT trial, environment, BOOL_OR(stage = 'evaluate') OVER () = (stage = 'evaluate') AS is_meant
    FROM study_trials
    WHERE study = {study}
),
runs AS (
    SELECT trials.*, worst_returns.worst_return
    FROM known
    INNER JOIN trials ON trials.trial = known.trial
    LEFT JOIN worst_returns ON worst_returns.study = {study} AND worst_returns.environment = known.environment
    WHERE known.is_meant
),
parts AS (
    SELECT
        runs.trial,
        windows.low,
        windows.high,
        CAST(episodes.episodic_return AS DOUBLE) AS episodic_return,
        LEAST(episodes.first_step - 1 + episodes.length, windows.high * runs.steps)
        - GREATEST(episodes.first_step - 1, windows.low * runs.steps) AS steps
    FROM runs
    INNER JOIN episodes ON episodes.trial = runs.trial
    CROSS JOIN (VALUES {windows}) AS windows (low, high)
    WHERE episodes.ending IN ('terminated', 'truncated')
)
SELECT
    runs.agent,
    runs.environment,
    runs.seed,{hypers}
    parts.low,
    parts.high,
    CASE runs.status
        WHEN 'diverged' THEN ANY_VALUE(runs.worst_return)
        ELSE SUM(parts.episodic_return * parts.steps) / SUM(parts.steps)
    END AS mean_return
FROM runs
INNER JOIN parts ON parts.trial = runs.trial AND parts.steps > 0
GROUP BY runs.trial, runs.agent, runs.environment, runs.seed, runs.status,{hypers} parts.low, parts.high
ORDER BY ALL
"""


def window_means(study: str, windows: Iterable[Window], hypers: Iterable[str] = ()) -> str:
    """Return the SQL of the mean return of each run of a study in these parts of its steps, with some of its hyperparameters."""
    return _WINDOW_MEANS.format(
        study=quoted(study),
        windows=", ".join(f"({low}, {high})" for low, high in sorted(set(windows))),
        hypers="".join(f' runs."{name}",' for name in sorted(set(hypers))),
    )


class Runs:
    """What the tests read from a store, each study and region once."""

    def __init__(self, connection: duckdb.DuckDBPyConnection) -> None:
        self._connection = connection
        self._means: dict[str, pd.DataFrame] = {}

    def means(self, side: Side, window: Window) -> np.ndarray:
        """Return the mean returns [n] of the runs of a side in a part of the steps, by seed. NoDataError where there is none."""
        sql = window_means(side.study, [window], side.where)
        if sql not in self._means:
            self._means[sql] = self._connection.execute(sql).df()
        rows = self._means[sql]
        meant = (rows["agent"] == side.agent) & (rows["environment"] == side.environment)
        for name, value in side.where.items():
            meant &= rows[name] == value
        means = rows[meant].sort_values("seed")["mean_return"].dropna().to_numpy(np.float64)
        if not len(means):
            raise NoDataError(f'study "{side.study}" has no run of {side.text()} on {side.environment} yet')
        return means

    def region(self, side: Side, at: tuple[float, ...]) -> np.ndarray:
        """Return scores [X, L, K, S] of critic step-sizes (those of `at`), entropy scales, remaining settings and seeds."""
        assert side.environment is not None
        options = Options(agents=(side.agent,), environments=(side.environment,))
        data = sensitivity_data.load(self._connection, side.study, options)
        panel = data.arranged(side.agent, side.environment)
        kept = [not at or value in at for value in panel.x_values]
        if sum(kept) < (len(at) or 1):
            raise NoDataError(f'study "{side.study}" has no runs at the critic step-sizes {", ".join(map(str, at))}')
        return np.asarray(panel.scores[kept])
