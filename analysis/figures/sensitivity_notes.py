"""What a sensitivity figure says in words: its subtitle, what the regions are worth, and what is missing from it.

Widths are judged by `analysis.statistics.regions`: with an interval, beside what noise alone would give, beside a permutation
test, and beside the level, because a region is narrow where everything failed, too.
"""

from typing import Any

import numpy as np
import pandas as pd

from analysis.figures.scope import FEW_SEEDS, describe_diverged
from analysis.figures.sensitivity_data import SensitivityData
from analysis.figures.style import words
from analysis.statistics.estimate import Estimate
from analysis.statistics.regions import Region, region
from sweep.messages import UserError

RESAMPLES = 1_000
PERMUTATIONS = 1_000
_NEAR_WORST = 0.1
"""Of the way from the lowest to the highest return: a level below that is a failure."""


def subtitle(data: SensitivityData) -> str:
    """Return n, steps, stage and what each point is the best over: `mean over 2 tuning seeds, 20,000 steps; best over …`."""
    best = f"best over {', '.join(data.maximized)}" if data.maximized else "one setting a point"
    return f"{_seeds(data)}, {data.steps:,} steps; {best}"


def notes(data: SensitivityData, seed: int = 0) -> list[str]:
    """Return lines: the study, then of each panel the region's width and level, missing trials and cells, diverged trials."""
    lines = [f"study {data.study}: {subtitle(data)}"]
    judged = False
    for (agent, environment), progress in sorted(data.progress.items()):
        where = f"{agent} on {environment}"
        table, planned = data.panel(agent, environment), data.panel(agent, environment, planned=True)
        missing = planned.notna() & table.isna()
        empty = [f"({x:g}, {short(scale)})" for x in missing.index for scale in missing.columns if missing.loc[x, scale]]
        if table.notna().any(axis=None):
            lines.append(f"{where}: {_region(table)}")
            if table.notna().sum(axis=1).max() > 1:
                found = _judge(data, agent, environment, seed)
                judged = judged or isinstance(found, Region)
                lines.append(f"{where}: {_worth(found) if isinstance(found, Region) else found}")
            lines += [f"{where}: {line}" for line in _level(table, *data.ends(environment))]
        if progress.done < progress.planned:
            lines.append(f"{where}: {progress.done:,} of {progress.planned:,} trials")
        if empty and progress.done:
            lines.append(f"{where}: no data yet for ({data.x}, {data.over}) {', '.join(empty)}")
        if progress.diverged:
            lines.append(f"{where}: {progress.diverged:,} diverged, {describe_diverged(data.diverged)}")
    if judged:
        if data.seeds < FEW_SEEDS:
            lines.append(f"{data.seeds} tuning seeds: intervals and widths without the bias of noise say little")
        lines.append(
            f"intervals: 95 %, percentile bootstrap of the tuning seeds, {RESAMPLES:,} resamples; p: {PERMUTATIONS:,} "
            f"permutations of the lines within each seed; seed {seed}"
        )
    return lines


def short(value: Any) -> str:
    """Return a value of a hyperparameter as a legend shows it."""
    if isinstance(value, bool | np.bool_):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def _seeds(data: SensitivityData) -> str:
    fewest = data.seeds if data.lines.empty else int(data.lines["min_num_seeds"].min())
    seeds = f"{data.seeds} tuning {'seed' if data.seeds == 1 else 'seeds'}"
    return f"mean over {seeds}" if fewest == data.seeds else f"mean over {fewest} to {seeds}"


def _region(table: pd.DataFrame) -> str:
    """Return level and width together: a region is also narrow where everything failed."""
    best = f"best mean {np.nanmax(table.to_numpy(dtype=float)):.4g}"
    several = table[table.notna().sum(axis=1) > 1]
    if several.empty:
        return f"{best}; no region: one line at most at each {words(str(table.index.name)).lower()}"
    widths = (several.max(axis=1) - several.min(axis=1)).to_numpy(dtype=float)
    return f"{best}; region {widths.mean():.4g} wide on average, {widths.max():.4g} at most"


def _judge(data: SensitivityData, agent: str, environment: str, seed: int) -> Region | str:
    """Return what the region is worth, or why that cannot be said."""
    if data.diverged == "drop" and data.progress[agent, environment].diverged:
        return "no interval of the width: diverged runs are left out, so that settings differ in their seeds"
    try:
        scores = data.arranged(agent, environment).scores
        return region(scores, resamples=RESAMPLES, permutations=PERMUTATIONS, splits=100, seed=seed)
    except UserError as error:
        return f"no interval of the width: {error}"


def _worth(found: Region) -> str:
    corrected, level = found.corrected_width, found.level
    return (
        f"mean width {_ends(found.mean_width)}, {corrected.value:.4g} without the bias of noise; noise alone gives "
        f"{found.mean_noise_floor:.4g}; p = {found.p_value:.2g}; mean level of the lines {level.value:.4g} {_ends(level)}"
    )


def _ends(estimate: Estimate) -> str:
    return f"in [{estimate.low:.4g}, {estimate.high:.4g}]"


def _level(table: pd.DataFrame, worst: float, best: float) -> list[str]:
    """Return a warning where the lines lie so low that their distance says nothing."""
    points = table.to_numpy(dtype=float)
    highest, level = ((value - worst) <= _NEAR_WORST * (best - worst) for value in (np.nanmax(points), np.nanmean(points)))
    if not level:
        return []
    if worst == best:
        return [f"warning: every episode returned {worst:.4g}: a region without width says nothing of {table.columns.name}"]
    return [
        f"warning: the lines lie near the worst return ({worst:.4g}; the best is {best:.4g}): a narrow region says here that "
        f"{'everything' if highest else 'nearly everything'} failed, not that {table.columns.name} does not matter"
    ]
