"""What a sensitivity figure says in words: its subtitle, and what is missing from it."""

import numpy as np
import pandas as pd

from analysis.figures.sensitivity_data import SensitivityData


def subtitle(data: SensitivityData) -> str:
    """Return n, steps and what each point is the best over: `mean over 2 seeds, 20,000 steps; best over …`."""
    best = f"best over {', '.join(data.maximized)}" if data.maximized else "one setting a point"
    return f"{_seeds(data)}, {data.steps:,} steps; {best}"


def notes(data: SensitivityData) -> list[str]:
    """Return lines: the study, then of each panel the region's width, missing trials and cells, diverged trials."""
    lines = [f"study {data.study}: {subtitle(data)}"]
    for (agent, environment), progress in sorted(data.progress.items()):
        where = f"{agent} on {environment}"
        table, planned = data.panel(agent, environment), data.panel(agent, environment, planned=True)
        missing = planned.notna() & table.isna()
        empty = [f"({x:g}, {scale:g})" for x in missing.index for scale in missing.columns if missing.loc[x, scale]]
        if table.notna().any(axis=None):
            lines.append(f"{where}: {_region(table)}")
        if progress.done < progress.planned:
            lines.append(f"{where}: {progress.done:,} of {progress.planned:,} trials")
        if empty and progress.done:
            lines.append(f"{where}: no data yet for (critic_step_size, entropy_scale) {', '.join(empty)}")
        if progress.diverged:
            lines.append(f"{where}: {progress.diverged:,} diverged, counted as the worst return of the environment")
    return lines


def _seeds(data: SensitivityData) -> str:
    fewest = data.seeds if data.lines.empty else int(data.lines["min_num_seeds"].min())
    seeds = f"{data.seeds} {'seed' if data.seeds == 1 else 'seeds'}"
    return f"mean over {seeds}" if fewest == data.seeds else f"mean over {fewest} to {seeds}"


def _region(table: pd.DataFrame) -> str:
    """Return level and width together: a region is also narrow where everything failed."""
    best = f"best mean {np.nanmax(table.to_numpy(dtype=float)):.4g}"
    several = table[table.notna().sum(axis=1) > 1]
    if several.empty:
        return f"{best}; no region: one line at most at each critic step-size"
    widths = (several.max(axis=1) - several.min(axis=1)).to_numpy(dtype=float)
    return f"{best}; region {widths.mean():.4g} wide on average, {widths.max():.4g} at most"
