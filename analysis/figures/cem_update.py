"""One update of the cross-entropy method (thesis 2.4, Figure 2.1): what is sampled, what is kept, where the density goes."""

from typing import Any

import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.markers import TICKUP

from analysis.figures.drawing import Drawing
from analysis.figures.style import headline, legend, styled

TAKES: tuple[str, ...] = ()
"""No option of a study: a demonstration shows the same whatever was trained."""
_BLUE, _RED = (sns.color_palette("colorblind")[index] for index in (0, 3))


def draw(rows: pd.DataFrame, title: str) -> Drawing:
    """One update of the cross-entropy method. Above: the objective H with the samples on it; those at or above the threshold ζ,
    the elites, are filled. Below: the density that the samples were drawn from, and the density fitted to the elites by maximum
    likelihood, from which the next update samples; ticks on the axis are the samples, long ones the elites.
    """
    with styled():
        figure = Figure(figsize=(5.6, 4.6), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        _draw_objective(above, rows)
        _draw_densities(below, rows)
        samples, elites = of_series(rows, "sample"), of_series(rows, "elite")
        headline(figure, title, f"{len(samples)} samples; the best of them, the elites: {len(elites)}")
        legend(figure, [*above.lines, *below.lines[:2]])
    return Drawing(figure, rows, _notes(rows))


def of_series(rows: pd.DataFrame, series: str, update: int = 0) -> pd.DataFrame:
    """Return the rows of a series at an update, in ascending order of actions."""
    return rows[(rows["series"] == series) & (rows["update"] == update)].sort_values("action")


def draw_samples(axes: Axes, samples: pd.DataFrame, elites: pd.DataFrame) -> None:
    """Draw samples as open circles and, over them, elites as filled ones."""
    circle: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 5, "color": "black", "markeredgewidth": 0.8}
    axes.plot(samples["action"], samples["value"], markerfacecolor="white", label="samples", **circle)
    axes.plot(elites["action"], elites["value"], label="elites", **circle)


def _draw_objective(axes: Axes, rows: pd.DataFrame) -> None:
    sns.despine(ax=axes)
    objective, elites = of_series(rows, "objective"), of_series(rows, "elite")
    axes.plot(objective["action"], objective["value"], color="0.45", linewidth=1.6, label="objective H")
    threshold = elites["value"].min()
    axes.axhline(threshold, color="0.45", linestyle=":", linewidth=1.2, label="threshold ζ")
    draw_samples(axes, of_series(rows, "sample"), elites)
    axes.set_ylabel("H")


def _draw_densities(axes: Axes, rows: pd.DataFrame) -> None:
    sns.despine(ax=axes)
    for update, (label, color, dashes) in enumerate((("density before", _RED, "--"), ("density after", _BLUE, "-"))):
        density = of_series(rows, "density", update)
        axes.plot(density["action"], density["value"], color=color, linestyle=dashes, linewidth=1.8, label=label)
    for series, size in (("sample", 5), ("elite", 11)):
        actions = of_series(rows, series)["action"]
        ticks: dict[str, Any] = {
            "marker": TICKUP,
            "markersize": size,
            "markeredgewidth": 1,
            "color": "black",
            "linestyle": "none",
        }
        axes.plot(actions, [0.0] * len(actions), transform=axes.get_xaxis_transform(), clip_on=False, **ticks)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("Action")
    axes.set_ylabel("Density")


def _notes(rows: pd.DataFrame) -> list[str]:
    lines = []
    for update, when in enumerate(("before", "after")):
        parameters = of_series(rows, "density parameters", update).iloc[0]
        lines.append(f"{when}: mean {parameters['action']:.3g}, standard deviation {parameters['value']:.3g}")
    return lines
