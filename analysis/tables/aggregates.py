"""Aggregates over environments: what an agent's chosen settings come to, on all environments together."""

from collections.abc import Mapping
from typing import Any

import duckdb
import numpy as np
import pandas as pd
from scipy import stats

from analysis.chosen import Chosen, load_chosen, normalize, on_common_environments, same_seeds, studies_with_chosen_runs
from analysis.figures.options import Options
from analysis.statistics.aggregates import AGGREGATES, aggregate
from analysis.statistics.estimate import Estimate
from analysis.tables.table import Table

TAKES = ("by", "score", "normalizer", "agents", "environments")
FAILED = "share_failed"

studies = studies_with_chosen_runs


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """Normalized scores of the runs of chosen settings, aggregated over environments: a row for each regime, agent and
    statistic. mean and median are over environments of the mean over runs, iqm is the mean of the middle half of all runs on
    all environments, optimality_gap the mean shortfall from 1, share_failed the share of runs that diverged or failed. Runs are
    those of the evaluation stage, or the tuning runs of a study without one; only environments that all agents have count.
    Diverged runs score the worst return of the environment. Intervals are 95 % stratified bootstrap intervals (10,000 resamples
    of runs within each environment; where all environments have the same seeds these are drawn jointly). Where no run or
    every run failed a bootstrap has nothing to resample, and the interval of share_failed is Clopper and Pearson's. The
    normalizer is the study's unless another is asked for; the thesis' does not weigh environments equally.
    """
    chosen, notes = on_common_environments(load_chosen(connection, study, options))
    chosen = normalize(connection, chosen, options.normalizer)
    rows = [row for group in chosen.groups for row in _rows(group, options.seed)]
    data = pd.DataFrame(rows)
    data["normalizer"] = chosen.normalizer
    first = f"study {study}: {chosen.subtitle()}; 95 % stratified bootstrap intervals (10,000 resamples, seed {options.seed})"
    if not all(same_seeds(group.runs.values()) for group in chosen.groups):
        notes.append("seeds differ between environments: runs of each environment are resampled by themselves")
    return Table(data, [first, *notes, *chosen.notes()], chosen.sql)


def _rows(group: Chosen, seed: int) -> list[dict[str, Any]]:
    places = {environment: runs.scores for environment, runs in group.runs.items()}
    paired = same_seeds(group.runs.values())
    estimates = {name: _aggregate(places, name, paired, seed) for name in AGGREGATES}
    estimates[FAILED] = _share_failed(group, paired, seed)
    return [
        {
            "by": group.by,
            "agent": group.name,
            "statistic": name,
            "value": estimate.value,
            "low": estimate.low,
            "high": estimate.high,
            "num_environments": len(places),
            "num_runs": estimate.num_runs,
            "method": estimate.method,
        }
        for name, estimate in estimates.items()
    ]


def _aggregate(places: Mapping[str, np.ndarray], name: str, paired: bool, seed: int) -> Estimate:
    fewest = min(len(scores) for scores in places.values())
    if fewest > 1:
        return aggregate(places, name, paired=paired, seed=seed)
    width = max(len(scores) for scores in places.values())
    padded = np.array([np.append(scores, np.full(width - len(scores), np.nan)) for scores in places.values()])
    return Estimate(float(AGGREGATES[name](padded)), np.nan, np.nan, 0.95, "none: one run", fewest)


def _share_failed(group: Chosen, paired: bool, seed: int) -> Estimate:
    """Return the mean over environments of the share of runs that diverged or failed."""
    failed = {
        environment: np.append(runs.diverged, np.ones(runs.num_failed)).astype(float) for environment, runs in group.runs.items()
    }
    every = np.concatenate(list(failed.values()))
    if np.ptp(every) == 0:
        low, high = stats.binomtest(int(every.sum()), len(every)).proportion_ci(0.95, "exact")
        return Estimate(float(every[0]), low, high, 0.95, "Clopper–Pearson", min(map(len, failed.values())))
    paired = paired and not any(runs.num_failed for runs in group.runs.values())
    return _aggregate(failed, "mean", paired, seed)
