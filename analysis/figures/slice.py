"""Slices: how the score depends on each hyperparameter alone, around the best setting."""

from dataclasses import dataclass

import duckdb
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.figures import style
from analysis.figures.drawing import Drawing
from analysis.figures.options import NoDataError, Options
from analysis.figures.scope import Scope, describe_progress, find_scope, quoted
from analysis.figures.swept import Value, are_numbers, check_swept, find_swept

TAKES = ("x", "agents", "environments")
_STAR = "#c44e52"
_SQL = """
-- One row per (agent, environment, hyperparameter, value): the mean {score} over the tuning seeds of the setting that is
-- otherwise the best one, with Student's 95 % interval, and of the best setting that has the value.
SELECT
    slices.study,
    slices.agent,
    slices.environment,
    slices.hyperparameter,
    slices.value,
    slices.number,
    slices.at_best,
    slices.at_best - student_quantiles.quantile * setting_scores.standard_error AS low,
    slices.at_best + student_quantiles.quantile * setting_scores.standard_error AS high,
    slices.at_best_num_seeds,
    slices.at_best_setting,
    slices.best_over_others,
    slices.best_over_others_num_seeds,
    slices.best_over_others_setting,
    slices.num_settings
FROM slices
LEFT JOIN setting_scores
    ON setting_scores.study = slices.study
    AND setting_scores.agent = slices.agent
    AND setting_scores.environment = slices.environment
    AND setting_scores.setting = slices.at_best_setting
    AND setting_scores.stage = 'tune'
ASOF LEFT JOIN student_quantiles ON student_quantiles.degrees_of_freedom <= slices.at_best_num_seeds - 1
WHERE slices.study = {study}
ORDER BY slices.agent, slices.environment, slices.hyperparameter, slices.number, slices.value
"""
Panel = tuple[str, str, str]
"""Agent, environment, hyperparameter."""


@dataclass(frozen=True)
class _Slices:
    """What the figure shows: `rows` of the query, the values of each hyperparameter, and which panel is where.

    `x`: the one hyperparameter asked for, whose columns are environments; None where columns are hyperparameters.
    """

    scope: Scope
    x: str | None
    values: dict[str, list[Value]]
    rows: pd.DataFrame

    @property
    def layout(self) -> list[list[Panel]]:
        """Panels, row by row."""
        if self.x is not None:
            return [[(agent, place, self.x) for place in self.scope.environments] for agent in self.scope.agents]
        return [[(agent, place, name) for name in self.values] for agent, place in sorted(self.scope.progress)]

    def panel(self, panel: Panel) -> pd.DataFrame:
        """Return the rows of a panel, in the order of values."""
        agent, environment, name = panel
        rows = self.rows
        return rows[(rows["agent"] == agent) & (rows["environment"] == environment) & (rows["hyperparameter"] == name)]


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies with tuning runs that sweep a hyperparameter, the one asked for if any."""
    rows = connection.execute("SELECT DISTINCT study, hyperparameter FROM slices ORDER BY study").fetchall()
    return list(dict.fromkeys(study for study, name in rows if options.x in (None, name)))


def draw(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Drawing:
    """Mean score by one hyperparameter at a time. The solid line: the setting that has the value and is otherwise the best one
    of the agent on the environment, with Student's 95 % interval over the tuning seeds. The dashed line: the best setting that
    has the value, whatever its other hyperparameters; the two meet at the best setting, the star. Where they part, the other
    hyperparameters make up for this one. A row for each agent and environment and a column for each swept hyperparameter, or,
    for one hyperparameter, a row for each agent and a column for each environment. Diverged trials count by the study's rule: as
    the worst return of the environment, unless it drops them. The best setting is the best of many noisy means and thus
    optimistic, and so is the whole dashed line, which has no interval for that reason. A point is missing from the solid line
    where the study has no such setting or no run of it. Intervals much longer than the lines are cut off at the panel's edge.
    """
    data = _load(connection, study, options)
    with style.styled():
        figure = _figure(data, options.title)
    return Drawing(figure, data.rows, _notes(data), _sql(data.scope))


def _load(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> _Slices:
    scope = find_scope(connection, study, options)
    values = find_swept(connection, study, options)
    if options.x is not None:
        check_swept(connection, study, "x", options.x, values)
        values = {options.x: values[options.x]}
    rows = connection.execute(_sql(scope)).df()
    kept = [options.keeps(*row) for row in zip(rows["agent"], rows["environment"], strict=True)]
    rows = rows[np.array(kept, bool) & rows["hyperparameter"].isin(values)]
    if rows.empty:
        raise NoDataError(f'study "{study}" has no tuning run yet of a setting with {", ".join(values)}')
    return _Slices(scope, options.x, values, rows)


def _sql(scope: Scope) -> str:
    return _SQL.format(score=scope.score, study=quoted(scope.study))


def _figure(data: _Slices, title: str) -> Figure:
    layout = data.layout
    figure, panels = style.panels(len(layout), len(layout[0]), share_x="col", share_y="col" if data.x else "row")
    for axes, panel in zip(panels.flat, [panel for row in layout for panel in row], strict=True):
        _draw_panel(axes, data, panel)
    # panels share a y-axis by column or by row
    for axes, group in zip(*((panels[0], zip(*layout, strict=True)) if data.x else (panels[:, 0], layout)), strict=True):
        _limit(axes, pd.concat([data.panel(panel) for panel in group]))
    for column, axes in enumerate(panels[-1]):
        name = layout[0][column][2]
        axes.set_xlabel(style.words(name))
        _set_ticks(axes, data.values[name])
    if data.x:
        style.name_rows(panels, data.scope.agents)
        style.name_columns(panels, data.scope.environments)
    else:
        style.name_rows(panels, [f"{row[0][0]}\n{row[0][1]}" for row in layout])
        style.name_columns(panels, [style.words(name) for name in data.values])
    style.headline(figure, title, _subtitle(data.scope))
    figure.supylabel(data.scope.label, size=10)
    style.legend(figure, _handles())
    return figure


def _draw_panel(axes: Axes, data: _Slices, panel: Panel) -> None:
    rows = data.panel(panel)
    if rows.empty:
        style.remark(axes, _absence(data, panel))
        return
    known = [value.text for value in data.values[panel[2]]]
    numeric = are_numbers(data.values[panel[2]])
    x = (rows["number"] if numeric else rows["value"].map(known.index)).to_numpy(float)
    axes.plot(
        x, rows["best_over_others"], color="0.45", linestyle="--", marker="s", markersize=4, fillstyle="none", linewidth=1.3
    )
    at_best, low, high = (rows[name].to_numpy(float) for name in ("at_best", "low", "high"))
    (blue,) = style.ordered_colors(1)
    there = ~np.isnan(at_best)
    axes.plot(x[there], at_best[there], color=blue, marker="o", markersize=5, linewidth=1.6)
    known_ends = there & ~np.isnan(low)
    if known_ends.any():
        ends = np.stack([at_best - low, high - at_best])[:, known_ends]
        axes.errorbar(x[known_ends], at_best[known_ends], ends, fmt="none", ecolor=blue, elinewidth=1.0, capsize=2.5)
    best = int(np.nanargmax(at_best))
    axes.plot(x[best], at_best[best], marker="*", markersize=13, color=_STAR, markeredgecolor="white", zorder=5)


def _limit(axes: Axes, rows: pd.DataFrame) -> None:
    """Show all means, and of intervals what is no further from them than the means are from one another."""
    if rows.empty:
        return
    means, ends = (rows[names].to_numpy(float) for names in (["at_best", "best_over_others"], ["low", "high"]))
    lowest, highest = np.nanmin(means), np.nanmax(means)
    span = highest - lowest
    if span > 0:
        bottom, top = np.nanmin([lowest, *ends[:, 0]]), np.nanmax([highest, *ends[:, 1]])
        axes.set_ylim(max(bottom, lowest - span) - 0.08 * span, min(top, highest + span) + 0.08 * span)


def _set_ticks(axes: Axes, values: list[Value]) -> None:
    if are_numbers(values):
        style.hyper_axis(axes, [value.number for value in values if value.number is not None])
        return
    axes.set_xticks(range(len(values)), [value.label for value in values])
    axes.set_xlim(-0.4, len(values) - 0.6)
    if max(len(value.label) for value in values) > 6:
        axes.tick_params(axis="x", rotation=30)


def _absence(data: _Slices, panel: Panel) -> str:
    progress = data.scope.progress.get(panel[:2])
    if progress is None:
        return "not in this study"
    return "no data yet" if not progress.done else "not swept here"


def _handles() -> list[Line2D]:
    (blue,) = style.ordered_colors(1)
    return [
        Line2D([], [], color=blue, marker="o", label="the others as in the best setting"),
        Line2D([], [], color="0.45", linestyle="--", marker="s", fillstyle="none", label="best over the others"),
        Line2D([], [], color=_STAR, marker="*", markersize=11, linestyle="none", label="best setting"),
    ]


def _subtitle(scope: Scope) -> str:
    return scope.subtitle(" with Student's 95 % interval" if scope.seeds > 1 else ", no interval from one")


def _notes(data: _Slices) -> list[str]:
    lines = [f"study {data.scope.study}: {_subtitle(data.scope)}"]
    for place in sorted(data.scope.progress):
        found = [(name, data.panel((*place, name))) for name in data.values]
        best = [(name, rows.iloc[int(np.nanargmax(rows["at_best"].to_numpy(float)))]) for name, rows in found if len(rows)]
        if best:
            where = ", ".join(f"{name} = {row['value']}" for name, row in best)
            lines.append(f"{place[0]} on {place[1]}: best {best[0][1]['at_best']:.4g} at {where}")
    if data.scope.seeds == 1:
        lines.append("one tuning seed: no interval; it needs two at least")
    return [*lines, *describe_progress(data.scope)]
