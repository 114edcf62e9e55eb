"""The runs that a test is about: their mean returns in a part of the steps, and the scores behind a sensitivity region."""

import duckdb
import numpy as np

from analysis.claims.claims import Side
from analysis.figures import sensitivity_data
from analysis.figures.options import NoDataError, Options
from analysis.figures.query_text import quoted

WINDOW_MEANS = """
-- One row per run: the mean return over a part of its steps, each step with the return of its episode. Completed episodes count;
-- a diverged run has the worst return of the environment. Runs are those of the evaluation stage where the study has one.
SELECT
    runs.seed,
    CASE runs.status
        WHEN 'diverged' THEN ANY_VALUE(worst_returns.worst_return)
        ELSE SUM(parts.episodic_return * parts.steps) / SUM(parts.steps)
    END AS mean_return
FROM (
    SELECT study_trials.*, BOOL_OR(study_trials.stage = 'evaluate') OVER () AS is_evaluated
    FROM study_trials
    WHERE study = {study}
) AS known
INNER JOIN trials AS runs ON runs.trial = known.trial
INNER JOIN worst_returns ON worst_returns.study = known.study AND worst_returns.environment = known.environment
INNER JOIN (
    SELECT
        episodes.trial,
        CAST(episodes.episodic_return AS DOUBLE) AS episodic_return,
        LEAST(episodes.first_step - 1 + episodes.length, {high} * trials.steps)
        - GREATEST(episodes.first_step - 1, {low} * trials.steps) AS steps
    FROM episodes
    INNER JOIN trials ON trials.trial = episodes.trial
    WHERE episodes.ending IN ('terminated', 'truncated') AND trials.agent = {agent} AND trials.environment = {environment}
) AS parts ON parts.trial = runs.trial AND parts.steps > 0
WHERE
    known.stage = CASE WHEN known.is_evaluated THEN 'evaluate' ELSE 'tune' END
    AND runs.agent = {agent} AND runs.environment = {environment}{where}
GROUP BY runs.trial, runs.seed, runs.status
ORDER BY runs.seed
"""


class Runs:
    """What the tests read from a store, each once."""

    def __init__(self, connection: duckdb.DuckDBPyConnection) -> None:
        self._connection = connection
        self._known: dict[str, np.ndarray] = {}

    def means(self, side: Side, window: tuple[float, float]) -> np.ndarray:
        """Return the mean returns [n] of the runs of a side in a part of the steps, by seed. NoDataError where there is none."""
        assert side.environment is not None
        where = "".join(f' AND runs."{name}" = {value}' for name, value in side.where.items())
        names = {name: quoted(str(getattr(side, name))) for name in ("study", "agent", "environment")}
        sql = WINDOW_MEANS.format(**names, low=window[0], high=window[1], where=where)
        if sql not in self._known:
            rows = self._connection.execute(sql).fetchall()
            self._known[sql] = np.array([mean for _, mean in rows if mean is not None], np.float64)
        if not len(self._known[sql]):
            raise NoDataError(f'study "{side.study}" has no run of {side.text()} on {side.environment} yet')
        return self._known[sql]

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
