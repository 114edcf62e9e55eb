"""The runs that tests are about: their mean returns in parts of the steps, and the scores behind a sensitivity region."""

from collections.abc import Iterable

import duckdb
import numpy as np
import pandas as pd

from analysis.claims.claims import Side
from analysis.figures import sensitivity_data
from analysis.figures.options import NoDataError, Options
from analysis.figures.query_text import listed

Window = tuple[float, float]
_WINDOW_MEANS = """
-- One row per run and window, a part of its steps from `low` to `high`: the mean return there, each step with the return of its
-- episode. Completed episodes count, and a run without any there has no row; a diverged run has the worst return of the
-- environment, in every window. Runs are those of the evaluation stage where the study has one.
WITH known AS (
    SELECT study, trial, environment, BOOL_OR(stage = 'evaluate') OVER (PARTITION BY study) = (stage = 'evaluate') AS is_meant
    FROM study_trials
    WHERE study IN ({studies})
),
runs AS (
    SELECT known.study, trials.*, worst_returns.worst_return
    FROM known
    INNER JOIN trials ON trials.trial = known.trial
    LEFT JOIN worst_returns ON worst_returns.study = known.study AND worst_returns.environment = known.environment
    WHERE known.is_meant
),
parts AS (
    SELECT
        runs.study,
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
    runs.study,
    runs.agent,
    runs.environment,
    runs.seed,{hypers}
    windows.low,
    windows.high,
    CASE runs.status
        WHEN 'diverged' THEN ANY_VALUE(runs.worst_return)
        ELSE SUM(parts.episodic_return * parts.steps) / SUM(parts.steps)
    END AS mean_return
FROM runs
CROSS JOIN (VALUES {windows}) AS windows (low, high)
LEFT JOIN parts
    ON parts.study = runs.study
    AND parts.trial = runs.trial
    AND parts.low = windows.low
    AND parts.high = windows.high
    AND parts.steps > 0
WHERE runs.status IN ('finished', 'diverged')
GROUP BY runs.study, runs.trial, runs.agent, runs.environment, runs.seed, runs.status,{hypers} windows.low, windows.high
HAVING ISFINITE(mean_return)
ORDER BY ALL
"""


def window_means(studies: Iterable[str], windows: Iterable[Window], hypers: Iterable[str] = ()) -> str:
    """Return the SQL of the mean return of each run of studies in these parts of its steps, with some of its hyperparameters."""
    return _WINDOW_MEANS.format(
        studies=listed(studies),
        windows=", ".join(f"({low}, {high})" for low, high in sorted(set(windows))),
        hypers="".join(f' runs."{name}",' for name in sorted(set(hypers))),
    )


class Runs:
    """What the tests read from a store, each study and region once."""

    def __init__(self, connection: duckdb.DuckDBPyConnection) -> None:
        self._connection = connection
        self._means: dict[str, pd.DataFrame] = {}

    def means(self, side: Side, window: Window) -> "pd.Series[float]":
        """Return seed → mean return in a part of the steps, of the runs of a side. NoDataError where there is none."""
        sql = window_means([side.study], [window], side.where)
        if sql not in self._means:
            self._means[sql] = self._connection.execute(sql).df()
        rows = self._means[sql]
        meant = (rows["agent"] == side.agent) & (rows["environment"] == side.environment)
        for name, value in side.where.items():
            meant &= rows[name] == value
        if not meant.any():
            raise NoDataError(f'study "{side.study}" has no run of {side.text()} on {side.environment} yet')
        return rows[meant].set_index("seed")["mean_return"].sort_index()

    def region(self, side: Side, at: tuple[float, ...]) -> np.ndarray:
        """Return scores [X, L, K, S] of critic step-sizes (those of `at`), entropy scales, remaining settings and seeds.

        Raises NoDataError as long as a run that the study plans there has no score.
        """
        assert side.environment is not None
        options = Options(agents=(side.agent,), environments=(side.environment,))
        data = sensitivity_data.load(self._connection, side.study, options)
        lacking = int(data.runs["score"].isna().sum())
        if lacking or data.runs.empty:
            what = f"{lacking:,} of {len(data.runs):,} runs" if len(data.runs) else "all runs"
            raise NoDataError(f'study "{side.study}" lacks {what} of {side.text()} on {side.environment}')
        panel = data.arranged(side.agent, side.environment)
        kept = [not at or value in at for value in panel.x_values]
        if sum(kept) < (len(at) or 1):
            raise NoDataError(f'study "{side.study}" has no runs at the critic step-sizes {", ".join(map(str, at))}')
        return np.asarray(panel.scores[kept])
