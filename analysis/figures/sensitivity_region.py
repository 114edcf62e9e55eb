"""Sensitivity regions (thesis 7.1, Figure 7.1): how far the entropy scale moves the best attainable return."""

import itertools
import textwrap

import duckdb
import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter, NullLocator

from analysis.figures.drawing import Drawing
from analysis.figures.sensitivity_data import Progress, SensitivityData, load, sensitivity_studies
from analysis.figures.sensitivity_notes import notes, subtitle

_BAND = "#f3c9a5"
_BAR = 0.05
"""Half the width in decades of the region of a single critic step-size."""
_MARKERS = "os^Dvp*"


def studies(connection: duckdb.DuckDBPyConnection) -> list[str]:
    """Return the studies that have data for the figure."""
    return sensitivity_studies(connection)


def draw(connection: duckdb.DuckDBPyConnection, study: str, title: str) -> Drawing:
    """Best average episodic return over the remaining hyperparameters, by critic step-size (log axis), a line for each
    entropy scale τ. The shaded region lies between the lowest and the highest line: the narrower it is, the less the
    entropy scale matters. Means over the tuning seeds; diverged trials count as the worst return of the environment.
    Hatched where lines are still missing, so that the region may yet grow. Each point is a maximum over settings and
    thus optimistic.
    """
    data = load(connection, study)
    with sns.axes_style("ticks", {"axes.grid": True, "grid.color": "0.92", "hatch.linewidth": 0.6}):
        figure = _figure(data, title)
    return Drawing(figure, data.lines, notes(data))


def _figure(data: SensitivityData, title: str) -> Figure:
    rows, columns = len(data.agents), len(data.environments)
    figure = Figure(figsize=(max(5.6, 1.0 + 2.75 * columns), 1.5 + 1.95 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey="col", squeeze=False)
    for (row, agent), (column, environment) in itertools.product(enumerate(data.agents), enumerate(data.environments)):
        _draw_panel(panels[row, column], data, agent, environment)
    _log_axis(panels[0, 0], data.values("critic_step_size"))
    for axes, agent in zip(panels[:, 0], data.agents, strict=True):
        axes.set_ylabel(agent, weight="bold", size=11)
    above = 18 if any(axes.get_title("right") for axes in panels[0]) else 6
    for axes, environment in zip(panels[0], data.environments, strict=True):
        axes.annotate(environment, (0.5, 1), (0, above), "axes fraction", "offset points", ha="center", weight="bold", size=11)
    for axes in panels[-1]:
        axes.set_xlabel("Critic step-size")
    lines = textwrap.wrap(subtitle(data), width=int(13 * figure.get_figwidth()))
    figure.suptitle("\n".join([title, *lines]), size=10, linespacing=1.4)
    figure.supylabel("Average episodic return", size=10)
    drawn = [axes for axes in panels.flat if axes.lines]
    if drawn:
        handles = [*drawn[0].lines, Patch(facecolor=_BAND, label="region")]
        columns = min(len(handles), int(figure.get_figwidth() / 0.9))
        spacing = {"columnspacing": 1.4, "handletextpad": 0.5, "handlelength": 1.8}
        figure.legend(
            handles=handles,
            ncols=columns,
            loc="outside lower center",
            title="Entropy scale τ",
            frameon=False,
            **spacing,
        )
    return figure


def _draw_panel(axes: Axes, data: SensitivityData, agent: str, environment: str) -> None:
    sns.despine(ax=axes)
    progress = data.progress.get((agent, environment))
    axes.set_title(_state(progress), loc="right", size=8, color="0.35", pad=4)
    table = data.panel(agent, environment)
    planned = data.panel(agent, environment, planned=True)
    if table.isna().all(axis=None):
        text = "no data yet" if planned.notna().any(axis=None) else "no entropy scale here" if progress else "not in this study"
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", color="0.4")
        return
    _draw_region(axes, table, planned)
    colors = sns.color_palette("viridis", table.shape[1] + 1)
    for index, scale in enumerate(table.columns):
        axes.plot(
            table.index,
            table[scale],
            color=colors[index],
            marker=_MARKERS[index % len(_MARKERS)],
            markersize=5,
            markeredgecolor="white",
            markeredgewidth=0.6,
            linewidth=1.6,
            label=f"{scale:g}",
        )


def _draw_region(axes: Axes, table: pd.DataFrame, planned: pd.DataFrame) -> None:
    """Fill between the lowest and the highest line, hatched where a planned line is missing at either end."""
    whole = (table.notna() | planned.isna()).all(axis=1).to_numpy()
    step_sizes = table.index.to_numpy()
    if len(table) == 1:  # one critic step-size: a region without width on the axis, drawn as a bar
        sides = step_sizes[0] * np.array([10**-_BAR, 10**_BAR])
        _fill(axes, sides, pd.concat([table, table]), bool(whole[0]))
    right = np.linspace(0, 1, 50)[:, None]  # lines may cross between two step-sizes: follow them
    for i in range(len(table) - 1):
        between = np.exp((1 - right) * np.log(step_sizes[i]) + right * np.log(step_sizes[i + 1]))
        lines = (1 - right) * table.iloc[i].to_numpy() + right * table.iloc[i + 1].to_numpy()
        _fill(axes, between[:, 0], pd.DataFrame(lines), bool(whole[i] and whole[i + 1]))


def _fill(axes: Axes, step_sizes: np.ndarray, lines: pd.DataFrame, complete: bool) -> None:
    region = axes.fill_between(
        step_sizes, lines.min(axis=1), lines.max(axis=1), facecolor=_BAND, edgecolor=_BAND, linewidth=0.2, zorder=1
    )
    if not complete:
        region.set(facecolor="none", linewidth=0, hatch="////")


def _state(progress: Progress | None) -> str:
    if progress is None:
        return ""
    parts = [f"{progress.done:,} of {progress.planned:,} trials"] if progress.done < progress.planned else []
    parts += [f"{progress.diverged:,} diverged"] if progress.diverged else []
    return ", ".join(parts)


def _log_axis(axes: Axes, step_sizes: list[float]) -> None:
    """A log axis (shared by the panels) with ticks at the values themselves, as far as they fit."""
    axes.set_xscale("log")
    axes.set_xlim(step_sizes[0] / 10**0.3, step_sizes[-1] * 10**0.3)
    if len(step_sizes) <= 7:
        axes.set_xticks(step_sizes, [_power(value) for value in step_sizes])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_minor_formatter(NullFormatter())


def _power(value: float) -> str:
    exponent = round(np.log10(value))
    return f"$10^{{{exponent}}}$" if np.isclose(value, 10.0**exponent, rtol=1e-9) else f"{value:g}"
