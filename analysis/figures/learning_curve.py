"""Learning curves of the chosen settings (thesis chapter 6, Figures 6.1 to 6.6, and Figure 7.2)."""

import duckdb
import numpy as np
import pandas as pd

from analysis.figures import curve_data, curve_runs, style
from analysis.figures.curve_data import Curve
from analysis.figures.curve_panels import draw_panels
from analysis.figures.curve_runs import CurveRuns, between
from analysis.figures.drawing import Drawing
from analysis.figures.options import NoDataError, Options
from analysis.figures.query_text import listed, quoted

TAKES = ("by", "agents", "environments", "over", "band")
_CHANGES = """
-- One row per (agent, environment, for_each, step) at which the mean over the chosen runs changes; it holds until the next.
SELECT agent, environment, for_each, step, mean, standard_error, num_seeds
FROM learning_curve_changes
WHERE study = {study} AND "by" = {by} AND agent IN ({agents}) AND environment IN ({environments})
ORDER BY agent, environment, for_each, step
"""
_EPISODES = """
-- One row per episode of the chosen runs, by run.
SELECT trial, episode, first_step, length, episodic_return, ending
FROM episodes
WHERE trial IN ({trials})
ORDER BY trial, episode
"""
_COUNTS = """
SELECT trial, episodes
FROM trials
WHERE trial IN ({trials})
"""
_LENGTHS = """
SELECT trial, MIN(length), MAX(length)
FROM episodes
WHERE trial IN ({trials}) AND ending <> 'budget' AND ISFINITE(episodic_return)
GROUP BY trial
"""


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies that have data for the figure."""
    return curve_runs.studies(connection, options)


def draw(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Drawing:
    """Average episodic return while learning, of the settings that were chosen, a panel for each environment and a line for each
    agent, or for each value of a hyperparameter for which a setting was chosen. Lines are means over runs; the band around
    them is one standard error to either side unless the heading says otherwise: no confidence interval. Runs are the
    evaluation runs, whose seeds had no part in the choice, unless the heading says that they are tuning runs. Where all episodes
    have one length, curves are by episode; otherwise each environment step counts the return of the episode that it belongs to.
    The steps of a last episode that the budget cut off repeat the return of the one before, and a run counts as the worst
    return of the environment from the episode on in which it diverged. Read at 500 points at most; nothing is smoothed.
    """
    chosen = curve_runs.load(connection, study, options)
    kind = options.band or "standard-error"
    lengths = _lengths(connection, chosen)
    sql, curves = _curves(connection, chosen, lengths, kind, options.seed)
    if not curves:
        raise NoDataError(f'study "{study}": no run of a chosen setting has completed an episode')
    labels = {name: "Episode" if lengths[name] else "Environment steps" for name in chosen.environments}
    with style.styled():
        figure = draw_panels(curves, chosen.environments, labels, values=chosen.values)
        tuned = f"; {chosen.tuned()}" if options.title.endswith(chosen.tuned()) else ""
        style.headline(figure, options.title, _subtitle(chosen, curves, kind).removesuffix(tuned))
    data = curve_data.tidy(curves)
    data.insert(0, "by", chosen.by)
    return Drawing(figure, data, _notes(chosen, curves, kind), sql)


def _lengths(connection: duckdb.DuckDBPyConnection, chosen: CurveRuns) -> dict[str, int | None]:
    """Return environment → the length of its episodes, None where they differ."""
    lengths: dict[str, int | None] = dict.fromkeys(chosen.environments)
    counts = dict(connection.execute(_COUNTS.format(trials=listed(chosen.finished["trial"]))).fetchall())
    for environment, group in chosen.finished.groupby("environment"):
        finished = group.loc[group["status"] == "finished", "trial"]
        if len({counts[trial] for trial in finished}) > 1:  # of one length there would be equally many
            continue
        rows = connection.execute(_LENGTHS.format(trials=listed(group["trial"]))).fetchall()
        found = {length for _, *ends in rows for length in ends}
        lengths[str(environment)] = found.pop() if len(found) == 1 else None
    return lengths


def _curves(
    connection: duckdb.DuckDBPyConnection, chosen: CurveRuns, lengths: dict[str, int | None], kind: str, seed: int
) -> tuple[str, list[Curve]]:
    """Return the query behind the figure and the lines, by environment, agent and value."""
    runs = chosen.finished
    sql = _CHANGES.format(
        study=quoted(chosen.study),
        by=quoted(chosen.by),
        agents=listed(runs["agent"]),
        environments=listed(runs["environment"]),
    )
    changes = connection.execute(sql).df()
    episodes = pd.DataFrame()
    if kind in ("bootstrap", "min-max", "runs"):
        sql = _EPISODES.format(trials=listed(runs["trial"]))
        episodes = connection.execute(sql).df()
    worst = dict(
        connection.execute("SELECT environment, worst_return FROM worst_returns WHERE study = ?", [chosen.study]).fetchall()
    )
    lines = dict(iter(changes.groupby(["environment", "agent", "for_each"])))
    curves = []
    for (environment, agent, _, value, for_each), group in runs.groupby(["environment", "agent", "rank", "value", "for_each"]):
        if (environment, agent, for_each) in lines:
            line = lines[environment, agent, for_each]
            own = _Runs(episodes, list(group["trial"]), worst.get(environment, np.nan))
            curves.append(_curve(chosen, line, own, lengths[str(environment)], str(value), kind, seed))
    return sql, curves


class _Runs:
    """The runs of a line, and their curves where somebody asks for them."""

    def __init__(self, episodes: pd.DataFrame, trials: list[str], worst: float) -> None:
        self.trials, self._episodes, self._worst = trials, episodes, worst

    def curves(self, at: np.ndarray) -> np.ndarray:
        """Return the curves [runs, points] of the runs that have one; `trials` are theirs from then on."""
        every = curve_data.run_curves(self._episodes[self._episodes["trial"].isin(self.trials)], self.trials, at, self._worst)
        whole = np.isfinite(every).all(axis=1)
        self.trials = [trial for trial, is_whole in zip(self.trials, whole, strict=True) if is_whole]
        return every[whole]


def _curve(chosen: CurveRuns, line: pd.DataFrame, own: _Runs, length: int | None, value: str, kind: str, seed: int) -> Curve:
    agent, environment = str(line["agent"].iloc[0]), str(line["environment"].iloc[0])
    at = curve_data.checkpoints(chosen.steps[environment], length)
    mean, error = (
        curve_data.read_at(line["step"].to_numpy(), line[name].to_numpy(float), at) for name in ("mean", "standard_error")
    )
    num_runs = int(line["num_seeds"].max())
    low, high = curve_data.surround(kind, mean, error, num_runs, lambda: own.curves(at), seed)
    return Curve(
        agent=agent,
        environment=environment,
        value=value,
        steps=at,
        x=(at - 1) // length + 1 if length else at,
        mean=mean,
        low=low,
        high=high,
        num_runs=num_runs,
        runs=own.curves(at) if kind == "runs" else None,
        trials=own.trials,
    )


def _subtitle(chosen: CurveRuns, curves: list[Curve], kind: str) -> str:
    """Return n, steps, kind of interval, stage and rule."""
    most = max(curve.num_runs for curve in curves)
    runs = chosen.kind_of_runs() if most > 1 else chosen.kind_of_runs().removesuffix("s")
    biased = " that the settings were chosen by" if chosen.is_biased else ""
    what = curve_data.BANDS[kind] if most > 1 or kind not in curve_data.INTERVALS else "a single run, no interval"
    tuned = f"; {chosen.tuned()}" if chosen.is_choice else ""
    return f"{what}; {between(curve.num_runs for curve in curves)} {runs}{biased} a line, {chosen.steps_text()}{tuned}"


def _notes(chosen: CurveRuns, curves: list[Curve], kind: str) -> list[str]:
    """Return lines: what is shown, what is missing, and where each line ends."""
    lines = [f"study {chosen.study}: {_subtitle(chosen, curves, kind)}", *chosen.notes()]
    for curve in curves:
        last = f"{chosen.line(curve.agent, curve.value)} on {curve.environment}: {curve.mean[-1]:.4g} at the end"
        if np.isfinite(curve.low[-1]):
            last += f" ({curve.low[-1]:.4g} to {curve.high[-1]:.4g})"
        lines.append(f"{last}, n = {curve.num_runs}" + ("; " + _why_none(curve, kind) if _why_none(curve, kind) else ""))
    return lines


def _why_none(curve: Curve, kind: str) -> str:
    return "one run gives no interval" if kind in curve_data.INTERVALS and curve.num_runs < 2 else ""
