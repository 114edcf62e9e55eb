"""The conditional cross-entropy method in one state (thesis 4.1, Figure 4.2): the actor concentrates before its proposal does."""

from typing import Any

import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.markers import TICKUP
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from analysis.figures.cem_update import draw_samples, of_series
from analysis.figures.drawing import Drawing
from analysis.figures.style import headline, legend, styled

TAKES: tuple[str, ...] = ()
"""No option of a study: a demonstration shows the same whatever was trained."""
_PANELS = 5
_POLICIES = {"actor": (sns.color_palette("colorblind")[0], "-"), "proposal": (sns.color_palette("colorblind")[3], "--")}
"""Color and dashes of each policy."""
_BOX = ((-0.3, 0), (0.3, 0), (0.3, 1), (-0.3, 1), (-0.3, 0))
"""The marker of an elite: a box around its tick."""


def draw(rows: pd.DataFrame, title: str) -> Drawing:
    """The conditional cross-entropy method, repeated in one state with fixed action values. Left, after so many updates. Above:
    the action values with the actions drawn from the proposal on them, the elites filled. Below: the densities of actor and
    proposal, in each panel on a scale of its own; ticks on the axis are the same actions, boxes the elites, to which both
    policies move next. Right: mean and standard deviation σ of both policies over all updates (σ below on a log axis), the mean
    against the best action. The proposal alone is rewarded for entropy: it stays wide while the actor concentrates.
    """
    updates = shown_updates(int(rows["update"].max()))
    with styled():
        figure = Figure(figsize=(10.5, 4.4), layout="constrained")
        grid = figure.add_gridspec(2, len(updates) + 1, width_ratios=(*[1.0] * len(updates), 2.0))
        values: list[Axes] = []
        for column in range(len(updates)):
            values.append(figure.add_subplot(grid[0, column], sharey=values[0] if values else None))
        densities = [figure.add_subplot(grid[1, column], sharex=values[column]) for column in range(len(updates))]
        for update, above, below in zip(updates, values, densities, strict=True):
            _draw_values(above, rows, update)
            _draw_densities(below, rows, update)
            _label(above, below, outer=above is values[0])
        mean = figure.add_subplot(grid[0, -1])
        std = figure.add_subplot(grid[1, -1], sharex=mean)
        _draw_progression(mean, std, rows)
        samples, elites = of_series(rows, "sample"), of_series(rows, "elite")
        headline(figure, title, f"{len(samples)} actions drawn an update; the best of them, the elites: {len(elites)}")
        legend(figure, [*values[0].lines, *densities[0].lines[:2], mean.lines[0]])
    return Drawing(figure, rows, _notes(rows))


def shown_updates(last: int) -> list[int]:
    """Return the updates that have a panel, of 0 … `last`: both ends, and between them ones ever further apart."""
    return sorted({round((last + 1) ** (step / (_PANELS - 1))) - 1 for step in range(_PANELS)})


def _draw_values(axes: Axes, rows: pd.DataFrame, update: int) -> None:
    sns.despine(ax=axes)
    objective = of_series(rows, "objective")
    axes.plot(objective["action"], objective["value"], color="0.45", linewidth=1.4, label="action values")
    draw_samples(axes, of_series(rows, "sample", update), of_series(rows, "elite", update))
    axes.set_title("before any update" if update == 0 else f"after {update} update{'' if update == 1 else 's'}", size=9)


def _draw_densities(axes: Axes, rows: pd.DataFrame, update: int) -> None:
    sns.despine(ax=axes)
    for name, (color, dashes) in _POLICIES.items():
        density = of_series(rows, name, update)
        axes.plot(density["action"], density["value"], color=color, linestyle=dashes, linewidth=1.8, label=name)
    axis: dict[str, Any] = {"linestyle": "none", "transform": axes.get_xaxis_transform(), "clip_on": False}
    samples, elites = (of_series(rows, series, update)["action"] for series in ("sample", "elite"))
    axes.plot(
        samples, [0.0] * len(samples), marker=TICKUP, markersize=6, markeredgewidth=1, color=_POLICIES["proposal"][0], **axis
    )
    box: dict[str, Any] = {"marker": _BOX, "markersize": 18, "markerfacecolor": "none", "color": "black", "markeredgewidth": 0.9}
    axes.plot(elites, [0.0] * len(elites), **box, **axis)
    axes.set_ylim(bottom=0)


def _draw_progression(mean: Axes, std: Axes, rows: pd.DataFrame) -> None:
    for axes in (mean, std):
        sns.despine(ax=axes)
    mean.axhline(_best_action(rows), color="0.45", linestyle=":", linewidth=1.4, label="best action")
    for name, (color, dashes) in _POLICIES.items():
        parameters = _parameters(rows, name)
        low, high = parameters["action"] - parameters["value"], parameters["action"] + parameters["value"]
        mean.fill_between(parameters["update"], low, high, color=color, alpha=0.2, linewidth=0)
        for axes, column in ((mean, "action"), (std, "value")):
            axes.plot(parameters["update"], parameters[column], color=color, linestyle=dashes, linewidth=1.8, label=name)
    mean.set_title("all updates", size=9)
    mean.set_ylabel("Mean ± σ")
    std.set_yscale("log")
    std.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    std.yaxis.set_major_formatter("{x:g}")
    std.yaxis.set_minor_formatter(NullFormatter())
    std.set_ylabel("Deviation σ")
    std.set_xlabel("Updates")
    mean.tick_params(labelbottom=False)


def _label(above: Axes, below: Axes, *, outer: bool) -> None:
    """Name the axes of a column of panels: action values have one axis for all columns, which the `outer` one names."""
    above.tick_params(labelbottom=False, labelleft=outer)
    above.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    below.yaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 5, 10]))
    below.set_xlabel("Action")
    if outer:
        above.set_ylabel("Action value")
        below.set_ylabel("Density")


def _best_action(rows: pd.DataFrame) -> float:
    objective = of_series(rows, "objective")
    return float(objective["action"].iloc[np.argmax(objective["value"])])


def _parameters(rows: pd.DataFrame, policy: str) -> pd.DataFrame:
    return rows[rows["series"] == f"{policy} parameters"].sort_values("update")


def _notes(rows: pd.DataFrame) -> list[str]:
    lines = []
    for policy in _POLICIES:
        last = _parameters(rows, policy).iloc[-1]
        lines.append(
            f"{policy} after {last['update']} updates: mean {last['action']:.3g}, standard deviation {last['value']:.3g} "
            f"(the best action: {_best_action(rows):.3g})"
        )
    return lines
