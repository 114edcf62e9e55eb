"""What a sensitivity figure shows: the best settings by two hyperparameters, the runs behind them, and what its study planned."""

from dataclasses import dataclass
from typing import Any

import duckdb
import numpy as np
import pandas as pd

from analysis.figures.options import NoDataError, Options
from analysis.figures.scope import LABELS, Progress, Scope, find_rule, quoted
from analysis.statistics.regions import Panel, arrange
from sweep.messages import UserError, suggestion

_IDENTITY = {"study", "stage", "trial", "setting", "agent", "environment", "seed", "steps"}
_LINES = """
-- One row per (agent, environment, {x}, {over}): the best setting among those that share both values, by the mean {score}
-- over the tuning seeds; of equally good ones the lowest setting hash. Diverged runs count by the study's rule.
WITH scored AS (
    SELECT agent, environment, setting, AVG({score} ORDER BY seed) AS {score}, COUNT({score}) AS num_seeds
    FROM run_scores
    WHERE study = {study} AND stage = 'tune'
    GROUP BY agent, environment, setting
),
planned AS (
    SELECT DISTINCT study, agent, environment, setting, "{x}", "{over}"
    FROM members
    WHERE study = {study} AND stage = 'tune' AND "{x}" IS NOT NULL AND "{over}" IS NOT NULL{panels}
)
SELECT
    study,
    agent,
    environment,
    "{x}",
    "{over}",
    MAX({score}) AS best_mean,
    FIRST(setting ORDER BY {score} DESC NULLS LAST, setting ASC) AS setting,
    FIRST(num_seeds ORDER BY {score} DESC NULLS LAST, setting ASC) AS num_seeds,
    MIN(num_seeds) FILTER (WHERE num_seeds > 0) AS min_num_seeds,
    COUNT({score}) AS num_settings,
    COUNT(*) AS num_settings_planned
FROM planned
INNER JOIN scored USING (agent, environment, setting)
GROUP BY study, agent, environment, "{x}", "{over}"
HAVING COUNT({score}) > 0
ORDER BY agent, environment, "{over}", "{x}"
"""
_RUNS = """
-- One row per run of the study's tuning stage.
SELECT agent, environment, setting, seed, status, {score} AS score
FROM run_scores
WHERE study = ? AND stage = 'tune'
"""
_RUN_SCORES = """
-- One row per (stage, agent, environment, setting, seed): the score of each run; a diverged run has the worst return, or by the
-- study's rule none.
SELECT study, stage, agent, environment, setting, seed, status, {score}
FROM run_scores
WHERE study = {study} AND stage IN ({stages}) AND agent IN ({agents}) AND environment IN ({environments})
ORDER BY ALL
"""
_SETTINGS = """
-- One row per (agent, environment, setting): its hyperparameters, planned seeds and steps.
SELECT agent, environment, setting, COUNT(*) AS planned, MAX(steps) AS most_steps, ANY_VALUE(COLUMNS({hypers}))
FROM members
WHERE study = ? AND stage = 'tune'
GROUP BY agent, environment, setting
ORDER BY agent, environment, setting
"""
_RETURNS = """
-- One row per (environment): the lowest and the highest return of one episode of the study's tuning runs.
SELECT members.environment, MIN(worst_returns.worst_return), MAX(trials.best_episode)
FROM members
INNER JOIN trials ON trials.trial = members.trial
INNER JOIN worst_returns ON worst_returns.study = members.study AND worst_returns.environment = members.environment
WHERE members.study = ? AND members.stage = 'tune'
GROUP BY members.environment
"""


@dataclass(frozen=True)
class SensitivityData:
    """Everything a sensitivity figure of one study says.

    `x` and `over` name the hyperparameters of the axis and of the lines. `planned` has a row per (agent, environment, x, over) of
    the tuning stage, `lines` the rows of `sql` for those that have data; `seeds` is the number of seeds planned a setting.
    `settings` has the hyperparameters of each setting, lists as texts; `runs` the score of each run, NaN where it has none.
    `returns`: environment → lowest and highest return of an episode. `diverged`: what diverged runs count for, "worst" or "drop".
    """

    study: str
    x: str
    over: str
    score: str
    sql: str
    lines: pd.DataFrame
    planned: pd.DataFrame
    settings: pd.DataFrame
    runs: pd.DataFrame
    progress: dict[tuple[str, str], Progress]
    returns: dict[str, tuple[float, float]]
    seeds: int
    steps: int
    maximized: list[str]
    diverged: str

    @property
    def agents(self) -> list[str]:
        """Agents in alphabetical order."""
        return sorted({agent for agent, _ in self.progress})

    @property
    def environments(self) -> list[str]:
        """Environments in alphabetical order."""
        return sorted({environment for _, environment in self.progress})

    def values(self, name: str) -> list[Any]:
        """Return the planned values of `x` or `over`, ascending."""
        return sorted(self.planned[name].unique())

    def panel(self, agent: str, environment: str, planned: bool = False) -> pd.DataFrame:
        """Return best means [x, over] of a panel, NaN where there is no data yet.

        With `planned`: how many settings each cell waits for (NaN where the study does not ask for the cell).
        """
        rows, column = (self.planned, "num_settings") if planned else (self.lines, "best_mean")
        table = _of(rows, agent, environment).pivot(index=self.x, columns=self.over, values=column).astype(float)
        return table.reindex(index=self.values(self.x), columns=self.values(self.over))

    @property
    def label(self) -> str:
        """What the axis of the score is named."""
        return LABELS[self.score]

    def arranged(self, agent: str, environment: str) -> Panel:
        """Return the scores of a panel's runs by x, line, remaining settings and seed, NaN where there is none.

        Raises UserError where there is one line, or settings that only differ in what is not swept.
        """
        settings = _of(self.settings, agent, environment).dropna(subset=[self.x, self.over]).reset_index(drop=True)
        runs = _of(self.runs, agent, environment)
        row = pd.Index(settings["setting"]).get_indexer(runs["setting"])
        runs, row = runs[row >= 0], row[row >= 0]
        seed, seeds = pd.factorize(runs["seed"], sort=True)
        scores = np.full((len(settings), len(seeds)), np.nan)
        scores[row, seed] = runs["score"]
        columns = settings[[self.x, self.over, *self.maximized]].astype(object)
        hypers = {str(name): _plain(column.where(column.notna(), None)).tolist() for name, column in columns.items()}
        return arrange(scores, hypers, self.x, self.over)

    def ends(self, environment: str) -> tuple[float, float]:
        """Return the lowest and the highest return of one episode on an environment, NaN where there is none."""
        return self.returns.get(environment, (np.nan, np.nan))


def sensitivity_studies(connection: duckdb.DuckDBPyConnection, x: str, over: str) -> list[str]:
    """Return the studies with data that sweep `over`, or, if there are none, all with both and data."""
    known = hyperparameters(connection)
    if x not in known or over not in known:
        return []
    rows = connection.execute(
        f"""
        SELECT study, COUNT(DISTINCT "{over}") > 1
        FROM members
        WHERE stage = 'tune' AND study IN (
            SELECT study FROM settings WHERE stage = 'tune' AND num_seeds > 0 AND "{x}" IS NOT NULL AND "{over}" IS NOT NULL
        )
        GROUP BY study
        ORDER BY study
        """
    ).fetchall()
    return [study for study, swept in rows if swept] or [study for study, _ in rows]


def load(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> SensitivityData:
    """Return what the figure shows of `study`, finished or not.

    Raises UserError for a hyperparameter that no agent has or that cannot be an axis, NoDataError if the study has no such
    trials.
    """
    x, over = options.x or "critic_step_size", options.over or "entropy_scale"
    score = options.score or find_rule(connection, study, "score")
    known = hyperparameters(connection)
    for flag, name in (("x", x), ("over", over)):
        if name not in known:
            raise UserError(f'--{flag}: unknown hyperparameter "{name}": {suggestion(name, known)}')
    if x == over:
        raise UserError(f"--x and --over are both {x}: a region needs two hyperparameters")
    settings = _kept(connection.execute(_SETTINGS.format(hypers=known), [study]).df(), options)
    if settings[[x, over]].dropna().empty:
        raise NoDataError(f'study "{study}" has no tuning trial with both {x} and {over}{_asked(options)}')
    if not pd.api.types.is_numeric_dtype(settings[x]) or pd.api.types.is_bool_dtype(settings[x]):
        raise UserError(f"--x {x}: an axis needs numbers; exchange it with --over {over}")
    sql = _LINES.format(x=x, over=over, score=score, study=quoted(study), panels=_chosen_panels(settings, options))
    lines = connection.execute(sql).df()
    for rows in (lines, settings):
        rows[over] = _plain(rows[over])
    runs = _kept(connection.execute(_RUNS.format(score=score), [study]).df(), options)
    cells = settings.dropna(subset=[x, over]).groupby(["agent", "environment", x, over], as_index=False)
    return SensitivityData(
        study=study,
        x=x,
        over=over,
        score=score,
        sql=sql,
        lines=lines,
        planned=cells.agg(num_settings=("setting", "size")),
        settings=settings,
        runs=runs,
        progress=_progress(runs),
        returns={place: (low, high) for place, low, high in connection.execute(_RETURNS, [study]).fetchall()},
        seeds=int(settings["planned"].max()),
        steps=int(settings["most_steps"].max()),
        maximized=_maximized(settings, [name for name in known if name not in (x, over)]),
        diverged=find_rule(connection, study, "diverged"),
    )


def hyperparameters(connection: duckdb.DuckDBPyConnection) -> list[str]:
    """Return the hyperparameters that any trial of the store has."""
    names = [row[0] for row in connection.execute("DESCRIBE members").fetchall()]
    return [name for name in names if name not in _IDENTITY]


def run_scores(scope: Scope, *stages: str) -> str:
    """Return the SQL of the scores of the runs that a figure or table of a scope is computed from."""
    return _RUN_SCORES.format(
        score=scope.score,
        study=quoted(scope.study),
        stages=", ".join(map(quoted, stages or ("tune",))),
        agents=", ".join(map(quoted, scope.agents)),
        environments=", ".join(map(quoted, scope.environments)),
    )


def _kept(rows: pd.DataFrame, options: Options) -> pd.DataFrame:
    pairs = {pair: options.keeps(*pair) for pair in set(zip(rows["agent"], rows["environment"], strict=True))}
    return rows[[pairs[pair] for pair in zip(rows["agent"], rows["environment"], strict=True)]].reset_index(drop=True)


def _of(rows: pd.DataFrame, agent: str, environment: str) -> pd.DataFrame:
    return rows[(rows["agent"] == agent) & (rows["environment"] == environment)]


def _asked(options: Options) -> str:
    asked = [*options.agents, *options.environments]
    return f" (of {', '.join(asked)})" if asked else ""


def _chosen_panels(settings: pd.DataFrame, options: Options) -> str:
    """Return the conditions that agents and environments be those asked for."""
    conditions = ""
    for column, asked in (("agent", options.agents), ("environment", options.environments)):
        if asked:
            names = ", ".join(map(quoted, sorted(settings[column].unique())))
            conditions += f"\n    AND {column} IN ({names})"
    return conditions


def _progress(runs: pd.DataFrame) -> dict[tuple[str, str], Progress]:
    diverged = runs["status"] == "diverged"
    done = diverged | (runs["status"] == "finished")
    counts = runs.assign(done=done, diverged=diverged).groupby(["agent", "environment"])
    table = counts.agg(planned=("status", "size"), done=("done", "sum"), diverged=("diverged", "sum")).reset_index()
    return {(str(agent), str(place)): Progress(*map(int, known)) for agent, place, *known in table.to_numpy().tolist()}


def _plain(values: "pd.Series[Any]") -> "pd.Series[Any]":
    """Return values that can be sorted and grouped: lists as texts."""
    if values.dtype != object:
        return values
    return values.map(lambda value: str(np.asarray(value).tolist()) if isinstance(value, np.ndarray | list) else value)


def _maximized(settings: pd.DataFrame, others: list[str]) -> list[str]:
    """Return the hyperparameters beside the two of the figure that differ between settings of an agent."""
    per_panel = settings.groupby(["agent", "environment"])
    return [name for name in others if int(per_panel[name].agg(_num_values).max()) > 1]


def _num_values(values: "pd.Series[Any]") -> int:
    return len({str(value) for value in values.dropna()})
