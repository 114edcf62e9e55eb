"""Performance profiles: how large a share of an agent's runs is better than each score."""

from typing import Any

import duckdb
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.chosen import (
    Chosen,
    ChosenRuns,
    load_chosen,
    normalize,
    on_common_environments,
    same_seeds,
    studies_with_chosen_runs,
)
from analysis.figures import style
from analysis.figures.drawing import Drawing
from analysis.figures.options import Options
from analysis.statistics.bands import Band
from analysis.statistics.profiles import performance_profile

TAKES = ("by", "score", "normalizer", "agents", "environments")
_MOST_POINTS = 300
_RESAMPLES = 2_000

studies = studies_with_chosen_runs


def draw(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Drawing:
    """Performance profiles of the chosen settings: the share of runs, over all environments, with a normalized score above a
    threshold, a line an agent, a panel a tuning regime. Each environment counts the same, and only environments that all
    agents have count. A line that lies above another everywhere belongs to the better agent; where it crosses the height ½ is
    the median. Runs are those of the evaluation stage, or the tuning runs of a study without one, which are too good;
    diverged runs count by the study's rule (worst return, or left out). Bands are pointwise 95 % stratified bootstrap bands
    (2,000 resamples of runs within each environment; where all environments have the same seeds these are drawn jointly). The
    normalizer is the study's unless another is asked for: percentile or cdf let environments weigh about the same, the
    thesis' does not.
    """
    every = load_chosen(connection, study, options)
    chosen, notes = on_common_environments(every)
    notes += [f"{line}: left out" for line in every.unscored]
    chosen = normalize(connection, chosen, options.normalizer)
    thresholds = _thresholds(chosen)
    profiles = [(group, _profile(group, thresholds, options.seed)) for group in chosen.groups]
    with style.styled():
        figure = _figure(chosen, thresholds, profiles, options.title)
    data = pd.concat([_rows(chosen, group, thresholds, profile) for group, profile in profiles], ignore_index=True)
    first = f"study {study}: {_subtitle(chosen)}; {_RESAMPLES:,} resamples, seed {options.seed}"
    return Drawing(figure, data, [first, *notes, *_medians(profiles), *chosen.notes()], chosen.sql)


def _thresholds(chosen: ChosenRuns) -> np.ndarray:
    """Return where a profile can change: every score, or quantiles of them where they are many."""
    scores = np.unique(np.concatenate([runs.scores for group in chosen.groups for runs in group.runs.values()]))
    if len(scores) > _MOST_POINTS:
        scores = np.unique(np.quantile(scores, np.linspace(0, 1, _MOST_POINTS)))
    margin = 0.02 * (float(np.ptp(scores)) or 1.0)
    return np.concatenate([[scores[0] - margin], scores])


def _profile(group: Chosen, thresholds: np.ndarray, seed: int) -> Band:
    places = {environment: runs.scores for environment, runs in group.runs.items()}
    if min(map(len, places.values())) > 1:
        paired = same_seeds(group.runs.values())
        return performance_profile(places, thresholds, paired=paired, resamples=_RESAMPLES, seed=seed)
    shares = np.mean([(scores[:, None] > thresholds).mean(0) for scores in places.values()], axis=0)
    none = np.full(len(thresholds), np.nan)
    return Band(shares, none, none, 0.95, "none: one run", 1)


def _figure(chosen: ChosenRuns, thresholds: np.ndarray, profiles: list[tuple[Chosen, Band]], title: str) -> Figure:
    figure, panels = style.panels(1, len(chosen.regimes), share_y="all")
    colors, dashes = _looks(chosen)
    for axes, by in zip(panels[0], chosen.regimes, strict=True):
        for group, profile in profiles:
            if group.by == by:
                _draw_profile(axes, thresholds, profile, colors[group.name], dashes[group.name], group.name)
        axes.set_ylim(-0.03, 1.03)
        axes.set_xlabel(f"Normalized score ({chosen.normalizer})")
    panels[0, 0].set_ylabel("Share of runs above")
    style.name_columns(panels, [f"tuned {by.replace('-', ' ')}" for by in chosen.regimes])
    style.headline(figure, title, _subtitle(chosen))
    lines = [Line2D([], [], color=colors[name], linestyle=dashes[name], linewidth=1.6, label=name) for name in chosen.names]
    style.legend(figure, lines)
    return figure


def _draw_profile(axes: Axes, thresholds: np.ndarray, profile: Band, color: Any, dash: Any, name: str) -> None:
    # the share holds from each score up to the next
    axes.plot(thresholds, profile.value, drawstyle="steps-post", color=color, linestyle=dash, linewidth=1.6, label=name)
    if not np.isnan(profile.low).all():
        axes.fill_between(thresholds, profile.low, profile.high, step="post", color=color, alpha=0.18, linewidth=0)


def _looks(chosen: ChosenRuns) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return colors and dashes by name: agents keep their colors, several choices of one agent have colors in order."""
    names = chosen.names
    agents = {group.name: group.agent for group in chosen.groups}
    several = len(set(agents.values())) < len(names)
    colors = dict(zip(names, style.ordered_colors(len(names)), strict=True)) if several else style.agent_colors(names)
    return dict(colors), {name: style.DASHES[i % len(style.DASHES)] for i, name in enumerate(names)}


def _rows(chosen: ChosenRuns, group: Chosen, thresholds: np.ndarray, profile: Band) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "study": chosen.study,
            "by": group.by,
            "agent": group.name,
            "normalizer": chosen.normalizer,
            "threshold": thresholds,
            "share_above": profile.value,
            "low": profile.low,
            "high": profile.high,
            "num_runs": profile.num_runs,
            "num_environments": len(group.runs),
        }
    )


def _subtitle(chosen: ChosenRuns) -> str:
    counts = {len(group.runs) for group in chosen.groups}
    number = f"{min(counts)} to {max(counts)}" if len(counts) > 1 else str(min(counts))
    several = any(len(runs.scores) > 1 for group in chosen.groups for runs in group.runs.values())
    band = "pointwise 95 % stratified bootstrap band" if several else "no band from one run"
    return f"{chosen.subtitle()}, {number} {'environment' if counts == {1} else 'environments'}; {band}"


def _median(group: Chosen) -> float:
    """Return the score that half of the runs lie above, each environment with the same weight."""
    scores = np.concatenate([runs.scores for runs in group.runs.values()])
    weights = np.concatenate([np.full(len(runs.scores), 1 / len(runs.scores)) for runs in group.runs.values()])
    order = np.argsort(scores, kind="stable")
    half = len(group.runs) / 2
    below = np.cumsum(weights[order])
    upper = min(int(np.searchsorted(below, half * (1 + 1e-12), side="right")), len(scores) - 1)
    lower = min(int(np.searchsorted(below, half * (1 - 1e-12), side="left")), len(scores) - 1)
    return float(scores[order][[lower, upper]].mean())


def _medians(profiles: list[tuple[Chosen, Band]]) -> list[str]:
    lines = []
    for group, _ in profiles:
        worst = min(runs.scores.min() for runs in group.runs.values())
        lines.append(
            f"{group.name}, tuned {group.by.replace('-', ' ')}: half of the runs above {_median(group):.4g}, "
            f"the worst {worst:.4g}"
        )
    return lines
