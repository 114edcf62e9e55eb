"""The plane of performance and hyperparameter sensitivity (Adkins, Bowling and White 2024): one point an agent."""

from collections.abc import Sequence
from typing import Any

import duckdb
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.figures import style
from analysis.figures.drawing import Drawing
from analysis.figures.options import Options
from analysis.figures.scope import Scope, find_scope
from analysis.figures.sensitivity_data import run_scores
from analysis.tables.sensitivity import (
    RESAMPLES,
    TAKES,
    Measured,
    check_normalizer,
    find_reference,
    measure,
    notes,
    rows,
    studies,
)

__all__ = ["TAKES", "draw", "studies"]

_TUNED: dict[str, Any] = {"color": "0.45", "linewidth": 0.9, "linestyle": "--"}
_COMPROMISE: dict[str, Any] = {"color": "0.45", "linewidth": 0.9, "linestyle": ":"}
"""The lines through the reference agent."""


def draw(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Drawing:
    """Performance against hyperparameter sensitivity, a point an agent. Vertical axis: the mean over environments of the
    normalized score of the best setting of each environment. Horizontal axis: how much of it is lost with the best single
    setting for all environments, Φ. Up and left is better. The lines through the reference agent (SAC, or the first) part the
    plane: above the horizontal line an agent is better tuned to each environment; left of the line of slope 1, better with
    one setting for all. Scores of tuning runs under the percentile normalizer unless another is asked for: 0 is the 5th, 1
    the 95th percentile of the settings of all agents on an environment. Crosses are 95 % percentile intervals over 10,000
    bootstrap resamples of the seeds, the same for all settings and environments. Diverged runs count by the study's rule (as the
    worst return; where any is left out there is nothing to show). Both coordinates are maxima over noisy
    means: Φ is above 0 by luck alone, and its interval may begin at the point.
    The data and notes have Φ on evaluation seeds, without that luck, where settings were chosen by both rules and evaluated.
    """
    scope = find_scope(connection, study, options)
    normalizer = check_normalizer(options)
    measured = measure(connection, scope, normalizer, options.seed)
    with style.styled():
        figure = _figure(scope, normalizer, measured, options.title)
    lines = notes(scope, normalizer, measured, options.seed)
    return Drawing(figure, rows(scope, normalizer, measured), lines, run_scores(scope, "tune", "evaluate"))


def _figure(scope: Scope, normalizer: str, measured: Sequence[Measured], title: str) -> Figure:
    figure, panels = style.panels(1, 1)
    figure.set_size_inches(6.4, 5.2)
    axes = panels[0, 0]
    known = [one for one in measured if one.found]
    colors = style.agent_colors([one.agent for one in known])
    for index, one in enumerate(known):
        _draw_point(axes, one, colors[one.agent], style.MARKERS[index % len(style.MARKERS)])
    _limit(axes, known)
    if len(known) > 1:
        _draw_reference(axes, find_reference(measured))
    axes.set_xlabel("Sensitivity Φ: loss with one setting for all environments")
    axes.set_ylabel("Normalized score, tuned to each environment")
    interval = f"95 % bootstrap intervals ({RESAMPLES:,} resamples), {normalizer} normalizer"
    style.headline(figure, title, f"{scope.subtitle()}; {interval}")
    handles = [
        Line2D(
            [], [], color=colors[one.agent], marker=style.MARKERS[index % len(style.MARKERS)], linestyle="none", label=one.agent
        )
        for index, one in enumerate(known)
    ]
    if len(known) > 1:
        reference = find_reference(measured).agent
        handles.append(Line2D([], [], **_TUNED, label=f"as good as {reference} when tuned to each"))
        handles.append(Line2D([], [], **_COMPROMISE, label=f"as good as {reference} with one setting"))
    style.legend(figure, handles)
    return figure


def _draw_point(axes: Axes, one: Measured, color: tuple[float, float, float], marker: str) -> None:
    assert one.found
    x, y = one.found.sensitivity, one.found.tuned
    axes.plot([x.low, x.high], [y.value, y.value], color=color, linewidth=1.5)
    axes.plot([x.value, x.value], [y.low, y.high], color=color, linewidth=1.5)
    axes.plot(
        x.value, y.value, color=color, marker=marker, markersize=8, markeredgecolor="white", linestyle="none", label=one.agent
    )


def _limit(axes: Axes, known: Sequence[Measured]) -> None:
    """Show all crosses, Φ from 0 on, with room for the names of the regions."""
    found = [one.found for one in known if one.found]
    right = max(max(one.sensitivity.high, one.sensitivity.value) for one in found)
    low = min(min(one.tuned.low, one.tuned.value) for one in found)
    high = max(max(one.tuned.high, one.tuned.value) for one in found)
    left = min(0.0, *(one.sensitivity.low for one in found))
    right, room = max(right, left + 0.05), max(0.25 * (high - low), 0.05)
    axes.set_xlim(left - 0.04 * (right - left), right + 0.12 * (right - left))
    axes.set_ylim(low - room, high + room)


def _draw_reference(axes: Axes, reference: Measured) -> None:
    """Draw the lines that part the plane, and say in its corners where an agent is better than the reference."""
    assert reference.found
    x, y = reference.found.sensitivity.value, reference.found.tuned.value
    ends = np.array(axes.get_xlim())
    axes.axhline(y, zorder=1, **_TUNED)
    axes.plot(ends, y + ends - x, zorder=1, **_COMPROMISE)
    look: dict[str, Any] = {"transform": axes.transAxes, "size": 8, "color": "0.35", "style": "italic"}
    than = f"than {reference.agent}"
    axes.text(0.02, 0.98, f"better {than} either way", ha="left", va="top", **look)
    axes.text(0.98, 0.02, f"worse {than} either way", ha="right", va="bottom", **look)
