"""How far runs of the chosen settings lie apart: every run's score, their mean, and between which scores most runs lie."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import duckdb
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.chosen import ChosenRuns, Runs, load_chosen, studies_with_chosen_runs
from analysis.figures import style
from analysis.figures.drawing import Drawing
from analysis.figures.options import Options
from analysis.figures.scope import LABELS
from analysis.statistics.estimate import Estimate
from analysis.statistics.intervals import interval
from analysis.statistics.tolerance import ToleranceInterval, tolerance_interval

TAKES = ("by", "agents", "environments", "score")
_MOST_COLUMNS = 3
_WIDTH = 0.8
"""Of the room between two agents, what the regimes share."""
_FILLED = {"per-environment": True, "across-environments": False}


@dataclass(frozen=True)
class Group:
    """The runs of one chosen setting, at `place` on the x-axis of a panel; intervals are None for a single run."""

    by: str
    agent: str
    name: str
    environment: str
    place: float
    runs: Runs
    mean: Estimate | None
    tolerance: ToleranceInterval | None


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies that have data for the figure."""
    return studies_with_chosen_runs(connection, options)


def draw(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Drawing:
    """The score of every run of the chosen settings, a panel for each environment: a point for each run, the mean of the runs
    with its 95 % Student interval (thick), and how runs spread (thin): where there are enough runs, a tolerance interval that
    contains nine tenths of all runs with 95 % confidence; otherwise the lowest, the median and the highest run, which promise
    nothing of the kind. Filled points are of settings tuned per environment, open ones of settings tuned across environments.
    They are evaluation runs unless the heading says that they are the tuning runs that the settings were chosen by. Diverged
    runs count by the study's rule (worst return, or left out). The interval of the mean says how well the mean is known, the
    spread what a single run may be like.
    """
    chosen = load_chosen(connection, study, options)
    groups = _groups(chosen)
    with style.styled():
        figure = _figure(chosen, groups, options.title)
    return Drawing(figure, _table(groups), _notes(chosen, groups), chosen.sql)


def _groups(chosen: ChosenRuns) -> list[Group]:
    known = chosen.regimes
    found = []
    for of in chosen.groups:
        for environment, runs in of.runs.items():
            if not len(runs.scores):
                continue
            several = len(runs.scores) > 1
            place = chosen.names.index(of.name) + _WIDTH * ((known.index(of.by) + 0.5) / len(known) - 0.5)
            mean = interval(runs.scores) if several else None
            tolerance = tolerance_interval(runs.scores) if several else None
            found.append(Group(of.by, of.agent, of.name, environment, place, runs, mean, tolerance))
    return found


def _figure(chosen: ChosenRuns, groups: Sequence[Group], title: str) -> Figure:
    environments = chosen.environments
    columns = min(len(environments), _MOST_COLUMNS)
    figure, grid = style.panels(math.ceil(len(environments) / columns), columns, share_x=False)
    labels, x_label = _labels(chosen)
    colors = style.agent_colors(list(dict.fromkeys(group.agent for group in groups)))
    for axes, environment in zip(grid.flat, environments, strict=False):
        for group in groups:
            if group.environment == environment:
                _draw(axes, group, colors[group.agent], _WIDTH / len(chosen.regimes))
        if all(group.environment != environment for group in groups):
            style.remark(axes, "no run has a score")
        axes.set_title(environment, weight="bold", size=11)
        axes.grid(visible=False, axis="x")
        axes.set_xlim(-0.6, len(chosen.names) - 0.4)
        axes.set_xticks(range(len(labels)), labels, size=9)
        axes.set_xlabel(x_label)
        if sum(max(map(len, label.split("\n"))) for label in labels) > 28:
            axes.tick_params("x", rotation=25)
            for text in axes.get_xticklabels():
                text.set(ha="right", rotation_mode="anchor")
    for axes in list(grid.flat)[len(environments) :]:
        axes.remove()
    style.headline(figure, title, _subtitle(chosen, groups))
    figure.supylabel(LABELS[chosen.score], size=10)
    style.legend(figure, _handles(chosen, groups))
    return figure


def _labels(chosen: ChosenRuns) -> tuple[list[str], str]:
    """Return what stands at each place of the x-axis and below it: agents, or the values of one agent's one hyperparameter."""
    split = [name.split(", ") for name in chosen.names]
    if all(len(parts) == 2 for parts in split) and len({(agent, value.split(" = ")[0]) for agent, value in split}) == 1:
        return [value.split(" = ")[1] for _, value in split], style.words(split[0][1].split(" = ")[0])
    return ["\n".join(parts) for parts in split], ""


def _draw(axes: Axes, group: Group, color: tuple[float, float, float], room: float) -> None:
    """Draw the runs to the left of the group's place, their spread and their mean to the right."""
    scores = group.runs.scores
    spread = np.linspace(-0.36, 0.04, len(scores)) if len(scores) > 1 else np.array([-0.16])
    filled = color if _FILLED[group.by] else "none"
    # by seed from left to right, so that the same picture comes of the same runs
    axes.scatter(
        group.place + room * spread, scores, s=13, marker="o", facecolor=filled, edgecolor=color, linewidth=0.8, alpha=0.75
    )
    if group.mean is None or group.tolerance is None:
        return
    at = group.place + 0.26 * room
    low, high = (group.tolerance.low, group.tolerance.high) if group.tolerance.holds else (scores.min(), scores.max())
    marks = [low, high] if group.tolerance.holds else [low, float(np.median(scores)), high]
    axes.vlines(at, low, high, color="0.35", linewidth=0.9)
    axes.scatter([at] * len(marks), marks, s=36, marker="_", color="0.35", linewidth=0.9, zorder=2.5)
    axes.vlines(at, group.mean.low, group.mean.high, color=color, linewidth=3.5, alpha=0.6, zorder=2.6)
    axes.plot(
        [at], [group.mean.value], marker="D", markersize=4.5, color=color, markeredgecolor="white", markeredgewidth=0.6, zorder=3
    )


def _handles(chosen: ChosenRuns, groups: Sequence[Group]) -> list[Line2D]:
    words = {"per-environment": "tuned per environment", "across-environments": "tuned across environments"}
    point = {"linestyle": "none", "marker": "o", "markersize": 4.5, "color": "0.35"}
    shown = chosen.regimes if chosen.is_choice else []
    handles = [Line2D([], [], label=words[by], markerfacecolor="0.35" if _FILLED[by] else "none", **point) for by in shown]  # type: ignore[arg-type]
    handles = handles or [Line2D([], [], label="run", **point)]  # type: ignore[arg-type]
    if any(group.mean is not None for group in groups):
        handles.append(
            Line2D([], [], color="0.35", linewidth=3.5, alpha=0.6, marker="D", markersize=4.5, label="mean, 95 % interval")
        )
        handles.append(Line2D([], [], color="0.35", linewidth=0.9, marker="_", label=_spread_text(groups)))
    return handles


def _spread_text(groups: Sequence[Group]) -> str:
    holding = {group.tolerance.holds for group in groups if group.tolerance is not None}
    tolerance, extremes = "tolerance interval", "lowest, median, highest run"
    return f"{tolerance}, or {extremes}" if len(holding) > 1 else tolerance if True in holding else extremes


def _subtitle(chosen: ChosenRuns, groups: Sequence[Group]) -> str:
    """Return n, steps, score, stage, kind of interval."""
    biased = "; by which the settings were chosen" if chosen.is_choice and chosen.stage == "tune" else ""
    several = any(group.mean is not None for group in groups)
    kind = "95 % Student interval of the mean; thin: " + _spread_text(groups) if several else "a single run each, no interval"
    return f"{chosen.subtitle()}{biased}; {kind}"


def _table(groups: Sequence[Group]) -> pd.DataFrame:
    """Return a row per run."""
    parts = [
        pd.DataFrame(
            {
                "by": group.by,
                "agent": group.agent,
                "line": group.name,
                "environment": group.environment,
                "setting": group.runs.setting,
                "seed": group.runs.seeds,
                "score": group.runs.scores,
                "diverged": group.runs.diverged,
            }
        )
        for group in groups
    ]
    return pd.concat(parts, ignore_index=True)


def _notes(chosen: ChosenRuns, groups: Sequence[Group]) -> list[str]:
    """Return lines: what is shown, what is missing, and of each group mean and spread with what it attains."""
    lines = [f"study {chosen.study}: {_subtitle(chosen, groups)}", *chosen.notes()]
    for group in groups:
        scores = group.runs.scores
        where = f"{group.name} on {group.environment}, {group.by.replace('-', ' ')}"
        if group.mean is None or group.tolerance is None:
            lines.append(f"{where}: one run, {scores[0]:.4g}; no interval")
            continue
        mean = f"mean {group.mean.value:.4g} ({group.mean.low:.4g} to {group.mean.high:.4g}), n = {len(scores)}"
        runs = f"lowest {scores.min():.4g}, median {np.median(scores):.4g}, highest {scores.max():.4g}"
        spread = f"{group.tolerance.low:.4g} to {group.tolerance.high:.4g} {group.tolerance.describe()}"
        lines.append(f"{where}: {mean}; {spread if group.tolerance.holds else runs}")
    short = {len(group.runs.scores): group.tolerance for group in groups if group.tolerance and not group.tolerance.holds}
    lines += [f"no tolerance interval: {tolerance.describe()}" for _, tolerance in sorted(short.items())]
    return lines
