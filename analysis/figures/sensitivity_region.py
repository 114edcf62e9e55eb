"""Sensitivity regions (thesis 7.1, Figure 7.1): how far the entropy scale moves the best attainable return."""

import itertools
from collections.abc import Sequence

import duckdb
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator

from analysis.figures import style
from analysis.figures.drawing import Drawing
from analysis.figures.options import Options
from analysis.figures.scope import Progress
from analysis.figures.sensitivity_data import SensitivityData, load, sensitivity_studies
from analysis.figures.sensitivity_notes import notes, short, subtitle

TAKES = ("x", "over", "score", "agents", "environments")
_BAND = "#f3c9a5"
_BAR = 0.05
"""Half the width in decades of the region of a single value."""
_MANY = 7
"""More lines than this are thinner, more values than this have no tick each."""


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies that have data for the figure."""
    return sensitivity_studies(connection, options.x or "critic_step_size", options.over or "entropy_scale")


def draw(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Drawing:
    """Best average episodic return over the remaining hyperparameters, by critic step-size (log axis), a line for each
    entropy scale τ. The shaded region lies between the lowest and the highest line: the narrower it is, the less the
    entropy scale matters. Means over the tuning seeds; diverged runs count by the study's rule (worst return, or left out).
    Hatched where lines are still missing, so that the region may yet grow. Each point is a maximum over settings and
    thus optimistic. Other hyperparameters can take the places of the two. The notes judge the width: its 95 % bootstrap
    interval over seeds, the width that noise alone would give, a permutation test, and the level of the lines, because a
    region is narrow where everything failed, too.
    """
    data = load(connection, study, options)
    with style.styled():
        figure = _figure(data, options.title)
    return Drawing(figure, data.lines, notes(data, options.seed), data.sql)


def _figure(data: SensitivityData, title: str) -> Figure:
    figure, panels = style.panels(len(data.agents), len(data.environments), share_y="col")
    _scale_axis(panels[0, 0], data.values(data.x))
    for (row, agent), (column, environment) in itertools.product(enumerate(data.agents), enumerate(data.environments)):
        _draw_panel(panels[row, column], data, agent, environment)
    style.name_rows(panels, data.agents)
    style.name_columns(panels, data.environments)
    for axes in panels[-1]:
        axes.set_xlabel(style.words(data.x))
    style.headline(figure, title, subtitle(data))
    figure.supylabel(data.label, size=10)
    drawn = [axes for axes in panels.flat if axes.lines]
    if drawn:
        region = [Patch(facecolor=_BAND, label="region")] if any(axes.collections for axes in drawn) else []
        style.legend(figure, [*drawn[0].lines, *region], style.words(data.over))
    return figure


def _scale_axis(axes: Axes, values: Sequence[float]) -> None:
    """Make the x-axis (shared by all panels) one of a hyperparameter; beside a log axis, 0 has a place of its own."""
    style.hyper_axis(axes, values)
    positive = [value for value in values if value > 0]
    if min(values) < 0 or not positive or min(values) == min(positive) or not style.is_logarithmic(positive):
        return
    axes.set_xscale("symlog", linthresh=min(positive), linscale=0.6)
    axes.set_xlim(-0.3 * min(positive), max(positive) * 10**0.3)
    axes.xaxis.set_minor_locator(NullLocator())
    shown = values if len(values) <= _MANY else [0, positive[0], positive[-1]]
    axes.set_xticks(list(shown), [style.number(value) for value in shown])


def _draw_panel(axes: Axes, data: SensitivityData, agent: str, environment: str) -> None:
    progress = data.progress.get((agent, environment))
    axes.set_title(_state(progress), loc="right", size=8, color="0.35", pad=4)
    table = data.panel(agent, environment)
    planned = data.panel(agent, environment, planned=True)
    if table.isna().all(axis=None):
        absent = f"no {data.over.replace('_', ' ')} here" if progress else "not in this study"
        style.remark(axes, "no data yet" if planned.notna().any(axis=None) else absent)
        return
    if table.notna().sum(axis=1).max() > 1:
        _draw_region(axes, table, planned)
    colors = style.ordered_colors(table.shape[1])
    crowded = table.shape[1] > _MANY
    for index, scale in enumerate(table.columns):
        axes.plot(
            table.index,
            table[scale],
            color=colors[index],
            marker=style.MARKERS[index % len(style.MARKERS)],
            linestyle=style.DASHES[index % len(style.DASHES)] if crowded else "-",
            markersize=4 if crowded else 5,
            markeredgecolor="white",
            markeredgewidth=0.6,
            linewidth=1.1 if crowded else 1.6,
            label=short(scale),
        )


def _draw_region(axes: Axes, table: pd.DataFrame, planned: pd.DataFrame) -> None:
    """Fill between the lowest and the highest line, hatched where a planned line is missing at either end."""
    whole = (table.notna() | planned.isna()).all(axis=1).to_numpy()
    values = table.index.to_numpy(dtype=float)
    if len(table) == 1:  # a region without width on the axis, drawn as a bar
        sides = values[0] * np.array([10**-_BAR, 10**_BAR]) if values[0] > 0 else values[0] + np.array([-_BAR, _BAR])
        _fill(axes, sides, pd.concat([table, table]), bool(whole[0]))
    scale = axes.xaxis.get_transform()
    places = scale.transform(values)
    right = np.linspace(0, 1, 50)[:, None]  # lines may cross between two values: follow them
    for i in range(len(table) - 1):
        between = scale.inverted().transform((1 - right[:, 0]) * places[i] + right[:, 0] * places[i + 1])
        lines = (1 - right) * table.iloc[i].to_numpy() + right * table.iloc[i + 1].to_numpy()
        _fill(axes, between, pd.DataFrame(lines), bool(whole[i] and whole[i + 1]))


def _fill(axes: Axes, values: np.ndarray, lines: pd.DataFrame, complete: bool) -> None:
    region = axes.fill_between(
        values, lines.min(axis=1), lines.max(axis=1), facecolor=_BAND, edgecolor=_BAND, linewidth=0.2, zorder=1
    )
    if not complete:
        region.set(facecolor="none", linewidth=0, hatch="////")


def _state(progress: Progress | None) -> str:
    if progress is None:
        return ""
    parts = [f"{progress.done:,} of {progress.planned:,} trials"] if progress.done < progress.planned else []
    parts += [f"{progress.diverged:,} diverged"] if progress.diverged else []
    return ", ".join(parts)
