"""Panels of curves: one an environment, a line an agent, in the order and the look that all figures of curves share."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from analysis.figures import style
from analysis.figures.curve_data import Curve

_MOST_COLUMNS = 3
_MARKERS = 8

Key = tuple[str, str]
"""Agent and value: what a line is in every panel."""


def draw_panels(
    curves: Sequence[Curve],
    environments: Sequence[str],
    x_labels: dict[str, str],
    *,
    y_label: str = "Average episodic return",
    values: str = "",
) -> Figure:
    """Return a figure with a panel for each environment, three side by side, and one legend.

    `x_labels`: by environment. `values`: what the lines' values are of, the title of the legend.
    """
    columns = min(len(environments), _MOST_COLUMNS)
    rows = math.ceil(len(environments) / columns)
    figure, grid = style.panels(rows, columns, share_x=False)
    looks = _looks(curves)
    for axes, environment in zip(grid.flat, environments, strict=False):
        here = [curve for curve in curves if curve.environment == environment]
        axes.set_title(environment, weight="bold", size=11)
        axes.set_xlabel(x_labels[environment])
        axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10], integer=True))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: count(value)))
        for index, curve in enumerate(here):
            _draw(axes, curve, looks[curve.agent, curve.value], (index + 0.5) / len(here))
        if not here:
            style.remark(axes, "no data yet")
    for axes in list(grid.flat)[len(environments) :]:
        axes.remove()
    label, height = figure.supylabel(y_label, size=10), figure.get_figheight()
    if looks:
        style.legend(figure, [Line2D([], [], markersize=5, **look) for look in looks.values()], values or None)
    label.set_y(1 - 0.5 * height / figure.get_figheight())  # beside the panels, where the legend made the figure higher
    return figure


def count(value: float) -> str:
    """Return a number of steps as a tick shows it: 25k, 1.5M."""
    for unit, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:g}{letter}"
    return f"{value:g}"


def _looks(curves: Sequence[Curve]) -> dict[Key, dict[str, Any]]:
    """Return color, marker, dashes and label of each line. Agents differ in color; lines of one agent alone in shade."""
    keys = list(dict.fromkeys((curve.agent, curve.value) for curve in curves))
    agents = list(dict.fromkeys(agent for agent, _ in keys))
    alone = len(agents) == 1 < len(keys)
    colors = style.agent_colors(agents)
    shades = style.ordered_colors(len(keys))
    values = {agent: [value for of, value in keys if of == agent] for agent in agents}
    return {
        (agent, value): {
            "color": shades[index] if alone else _lightened(colors[agent], values[agent].index(value), len(values[agent])),
            "marker": style.MARKERS[index % len(style.MARKERS)],
            "linestyle": style.DASHES[index % len(style.DASHES)],
            "linewidth": 1.5,
            "label": value if alone else ", ".join(part for part in (agent, value) if part),
        }
        for index, (agent, value) in enumerate(keys)
    }


def _lightened(color: tuple[float, float, float], index: int, count: int) -> tuple[float, ...]:
    """Return an agent's color for the first of its lines, and lighter ones for the others."""
    share = 0.55 * index / max(1, count - 1)
    return tuple((1 - share) * part + share for part in color)


def _draw(axes: Axes, curve: Curve, look: dict[str, Any], place: float) -> None:
    """Draw a line and what surrounds it; `place` (0 to 1) shifts its markers, so that lines upon each other can be seen."""
    if curve.runs is not None:
        axes.plot(curve.x, curve.runs.T, color=look["color"], linewidth=0.5, alpha=0.4, zorder=1.5)
    elif np.isfinite(curve.low).any():
        axes.fill_between(curve.x, curve.low, curve.high, color=look["color"], alpha=0.2, linewidth=0, zorder=1)
    last = len(curve.x) - 1
    marks = np.arange(last + 1) if last < _MARKERS else ((np.arange(_MARKERS) + place) / _MARKERS * last).astype(int)
    look = look | {"markevery": list(marks), "markersize": 4.5, "markeredgecolor": "white", "markeredgewidth": 0.5}
    axes.plot(curve.x, curve.mean, **look, zorder=2)
