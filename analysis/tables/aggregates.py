"""Aggregates over environments: what an agent's chosen settings come to, on all environments together."""

from collections.abc import Mapping, Sequence
from typing import Any

import duckdb
import numpy as np
import pandas as pd
from scipy import stats

from analysis.chosen import (
    Chosen,
    ChosenRuns,
    load_chosen,
    normalize,
    on_common_environments,
    restrict,
    same_seeds,
    studies_with_chosen_runs,
)
from analysis.figures.options import Options
from analysis.statistics.aggregates import AGGREGATES, aggregate
from analysis.statistics.estimate import Estimate
from analysis.tables.table import Table

TAKES = ("by", "score", "normalizer", "agents", "environments")
FAILED = "share_failed"

studies = studies_with_chosen_runs


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """Normalized scores of the runs of chosen settings, aggregated over environments: a row for each regime, agent and
    statistic. mean and median are over environments of the mean over runs, iqm is the mean of the middle half of all runs on all
    environments, optimality_gap the mean shortfall from 1, share_failed the share of runs that diverged or failed, on
    environments without any score too, which the other statistics leave out. Runs are those of the evaluation stage, or the
    tuning runs of a study without one; only environments that all agents have count. Diverged runs count by the study's rule
    (worst return, or left out). Intervals are 95 % stratified bootstrap intervals (10,000 resamples of runs within each
    environment; where all environments have the same seeds these are drawn jointly). Where no run or every run failed a
    bootstrap has nothing to resample, and the interval of share_failed is Clopper and Pearson's. The normalizer is the study's
    unless another is asked for; the thesis' does not weigh environments equally.
    """
    every = load_chosen(connection, study, options)
    chosen, notes = on_common_environments(every)
    chosen = normalize(connection, chosen, options.normalizer)
    known = {(group.by, group.name): group for group in chosen.groups}
    rows = []
    for by in every.regimes:
        for group in _with_runs(every.of(by)):
            scored = known.get((by, group.name))
            rows += _rows(scored, options.seed) if scored else []
            rows.append(_row(group, FAILED, _share_failed(group, options.seed)))
    data = pd.DataFrame(rows)
    data["normalizer"] = chosen.normalizer
    first = f"study {study}: {chosen.subtitle()}; 95 % stratified bootstrap intervals (10,000 resamples, seed {options.seed})"
    if not all(same_seeds(group.runs.values()) for group in chosen.groups):
        notes.append("seeds differ between environments: runs of each environment are resampled by themselves")
    return Table(data, [first, *notes, *chosen.notes(), *_unscored(every)], chosen.sql)


def _with_runs(groups: Sequence[Chosen]) -> list[Chosen]:
    """Return groups that have runs, with a score or without, on the environments where all of these have some."""
    done = [group.on(place for place, runs in group.runs.items() if runs.num_done) for group in groups]
    done = [group for group in done if group.runs]
    kept, _ = restrict(done) if done else ([], [])
    return [group for group in kept if group.runs]


def _unscored(chosen: ChosenRuns) -> list[str]:
    return [f"{line}: left out but for {FAILED}" for line in chosen.unscored]


def _rows(group: Chosen, seed: int) -> list[dict[str, Any]]:
    places = {environment: runs.scores for environment, runs in group.runs.items()}
    paired = same_seeds(group.runs.values())
    return [_row(group, statistic, _aggregate(places, statistic, paired, seed)) for statistic in AGGREGATES]


def _row(group: Chosen, statistic: str, estimate: Estimate) -> dict[str, Any]:
    return {
        "by": group.by,
        "agent": group.name,
        "statistic": statistic,
        "value": estimate.value,
        "low": estimate.low,
        "high": estimate.high,
        "num_environments": len(group.runs),
        "num_runs": estimate.num_runs,
        "method": estimate.method,
    }


def _aggregate(places: Mapping[str, np.ndarray], name: str, paired: bool, seed: int) -> Estimate:
    fewest = min(len(scores) for scores in places.values())
    if fewest > 1:
        return aggregate(places, name, paired=paired, seed=seed)
    width = max(len(scores) for scores in places.values())
    padded = np.array([np.append(scores, np.full(width - len(scores), np.nan)) for scores in places.values()])
    return Estimate(float(AGGREGATES[name](padded)), np.nan, np.nan, 0.95, "none: one run", fewest)


def _share_failed(group: Chosen, seed: int) -> Estimate:
    """Return the mean over environments of the share of runs that diverged or failed."""
    failed = {
        environment: np.append(runs.diverged, np.ones(runs.num_failed + runs.num_dropped)).astype(float)
        for environment, runs in group.runs.items()
    }
    every = np.concatenate(list(failed.values()))
    if np.ptp(every) == 0:
        low, high = stats.binomtest(int(every.sum()), len(every)).proportion_ci(0.95, "exact")
        return Estimate(float(every[0]), low, high, 0.95, "Clopper–Pearson", min(map(len, failed.values())))
    paired = same_seeds(group.runs.values()) and not any(runs.num_failed or runs.num_dropped for runs in group.runs.values())
    return _aggregate(failed, "mean", paired, seed)
