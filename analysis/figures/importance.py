"""Importance of hyperparameters: bars of the share of the variance between settings, main effects and pairs."""

from collections.abc import Sequence
from typing import Any

import duckdb
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from analysis.figures import style
from analysis.figures.drawing import Drawing
from analysis.figures.options import Options
from analysis.figures.scope import Scope, find_scope
from analysis.figures.sensitivity_data import run_scores
from analysis.statistics.importance import Component, Importance
from analysis.tables.importance import TAKES, Measured, measure, notes, rows, studies

__all__ = ["TAKES", "draw", "studies"]

_MOST_PAIRS = 6
_REST, _HIGHER = "Other pairs", "Higher interactions"
_LOW, _HIGH = -0.25, 1.1
"""Ends of the axis at most: intervals of shares of hardly any variance have no bounds."""
_LOOKS: dict[str, dict[str, Any]] = {
    "one hyperparameter": {"facecolor": sns.color_palette("colorblind")[0], "edgecolor": "0.2"},
    "a pair, beyond both": {"facecolor": sns.color_palette("pastel")[1], "edgecolor": "0.2", "hatch": "////"},
    "the rest": {"facecolor": "0.85", "edgecolor": "0.2"},
}


def draw(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Drawing:
    """Share of the variance between the means of an agent's settings on an environment that is due to each hyperparameter
    alone (filled), to each pair beyond both (hatched), and to what is left: higher interactions, and pairs beyond the six
    largest (gray).
    An exact functional ANOVA on the full grid, on means over the tuning seeds; diverged runs count by the study's rule (as the
    worst return; where any is left out there is nothing to show). The variance of means that noise alone gives, σ²/n, is
    removed in proportion to the degrees of freedom, so that
    a bar may reach below 0: no effect that these runs can show. Lines are 95 % percentile intervals over 1,000 bootstrap
    resamples of the seeds, the same for all settings; bars and lines that leave the axis are cut off. Hyperparameters that do
    not vary independently are one factor. Panels whose grid is incomplete, or whose settings differ by no more than noise,
    have no shares.
    """
    scope = find_scope(connection, study, options)
    measured = measure(connection, scope, options.seed)
    with style.styled():
        figure = _figure(scope, measured, options.title)
    return Drawing(figure, rows(study, measured), notes(scope, measured, options.seed), run_scores(scope))


def _figure(scope: Scope, measured: Sequence[Measured], title: str) -> Figure:
    agents, environments = scope.agents, scope.environments
    found = {(known.agent, known.environment): known for known in measured}
    labels = {
        agent: _labels([known.importance for known in measured if known.agent == agent and known.importance]) for agent in agents
    }
    figure, panels = style.panels(len(agents), len(environments), share_x="all", share_y="row")
    height = sum(0.75 + 0.27 * max(4, sum(1 + label.count("\n") * 0.6 for label in labels[agent])) for agent in agents)
    figure.set_size_inches(figure.get_figwidth() + 1.4, 1.3 + height)
    for row, agent in enumerate(agents):
        for column, environment in enumerate(environments):
            axes = panels[row, column]
            _draw_panel(axes, found.get((agent, environment)), labels[agent])
            if column == 0:
                axes.set_yticks(range(len(labels[agent])), [*labels[agent]], size=7.5)
                axes.set_ylim(max(len(labels[agent]), 1) - 0.4, -0.6)
    style.name_rows(panels, agents)
    style.name_columns(panels, environments)
    _limit(panels[0, 0], measured)
    for axes in panels[-1]:
        axes.set_xlabel("Share of variance")
    interval = "95 % bootstrap intervals"
    style.headline(figure, title, f"{scope.subtitle()}; noise removed, {interval}")
    rest = any(label in (_REST, _HIGHER) for row in labels.values() for label in row)
    looks = list(_LOOKS.items()) if rest else list(_LOOKS.items())[:2]
    style.legend(figure, [Patch(label=label, **look) for label, look in looks])
    return figure


def _draw_panel(axes: Axes, known: Measured | None, labels: dict[str, int]) -> None:
    axes.axvline(0, color="0.3", linewidth=0.8)
    axes.grid(axis="y", visible=False)
    found = known.importance if known else None
    if found is None or not found.shares_defined:
        reason = "not in this study" if known is None else _reason(known) if found is None else "no more than noise"
        style.remark(axes, reason)
        return
    shown, rest = _bars(found)
    for component in shown:
        share = component.share
        place = labels[_label(component)]
        axes.barh(place, share.value, height=0.68, linewidth=0.6, **_look(component))
        axes.plot([share.low, share.high], [place, place], color="0.1", linewidth=1.1, marker="|", markersize=5)
    if rest:
        axes.barh(
            labels[_REST], sum(component.share.value for component in rest), height=0.68, linewidth=0.6, **_LOOKS["the rest"]
        )


def _reason(known: Measured) -> str:
    """Return in a few words why there is no importance; the notes have it in full."""
    if "leaves out" in known.missing:
        return "diverged runs left out"
    if "lack runs" in known.missing:
        return "runs are missing"
    if "full grid" in known.missing:
        return "not a full grid"
    return "one seed" if "at least 2 runs" in known.missing else "nothing to tell apart"


def _bars(found: Importance) -> tuple[list[Component], list[Component]]:
    """Return the components that have a bar of their own, and the pairs that share one."""
    pairs = [component for component in found.components if len(component.factors) == 2]
    rest = pairs[_MOST_PAIRS:] if len(pairs) > _MOST_PAIRS + 1 else []
    return [component for component in found.components if component not in rest], rest


def _labels(found: Sequence[Importance]) -> dict[str, int]:
    """Return label → place from the top: single hyperparameters by their mean share, pairs, the rest."""
    shares: dict[tuple[int, str], list[float]] = {}
    for known in found:
        shown, rest = _bars(known)
        for component in shown:
            shares.setdefault((len(component.factors) or 4, _label(component)), []).append(
                component.variance / (abs(known.variance) or 1)
            )
        if rest:
            shares.setdefault((3, _REST), [])
    order = sorted(shares, key=lambda key: (key[0], -sum(shares[key]) / max(1, len(shares[key]))))
    return {label: place for place, (_, label) in enumerate(order)}


def _label(component: Component) -> str:
    """Return the component's name in two lines at most, with the words of the axes of other figures."""
    parts = [" & ".join(style.words(name) for name in factor.split(" & ")) for factor in component.factors]
    return " ×\n".join(parts) if parts else _HIGHER


def _look(component: Component) -> dict[str, Any]:
    return dict(list(_LOOKS.values())[{1: 0, 2: 1}.get(len(component.factors), 2)])


def _limit(axes: Axes, measured: Sequence[Measured]) -> None:
    """Show all bars, and intervals as far as they are of use."""
    known = [
        component.share
        for one in measured
        if one.importance and one.importance.shares_defined
        for component in one.importance.components
    ]
    low = min((max(min(share.low, share.value), _LOW) for share in known), default=0.0)
    high = max((min(max(share.high, share.value), _HIGH) for share in known), default=1.0)
    axes.set_xlim(min(low - 0.05, -0.05), max(high + 0.05, 0.5))
    axes.xaxis.set_major_locator(MaxNLocator(4))
