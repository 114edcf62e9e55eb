"""Performance of the chosen settings on each environment, with every interval that a reader may want."""

from typing import Any

import duckdb
import numpy as np
import pandas as pd

from analysis.chosen import Chosen, Runs, load_chosen, studies_with_chosen_runs
from analysis.figures.options import Options
from analysis.statistics.aggregates import interquartile_mean
from analysis.statistics.estimate import Estimate
from analysis.statistics.intervals import interval
from analysis.statistics.tolerance import runs_needed, tolerance_interval
from analysis.tables.table import Table
from sweep.messages import UserError

TAKES = ("by", "score", "agents", "environments")
ALPHA, BETA = 0.05, 0.9

studies = studies_with_chosen_runs


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """Scores of the runs of each chosen setting: a row for each agent, environment and tuning regime. Runs are those of the
    evaluation stage, on seeds that had no part in the choice; of a study without one, the tuning runs, which are too good.
    Diverged runs count by the study's rule (worst return, or left out); failed and missing runs are left out, and all are
    counted; without any score there are no numbers. low and high are Student's 95 % interval of the mean, bootstrap_low and
    bootstrap_high the BCa bootstrap's (10,000 resamples; the percentile bootstrap's where BCa is undefined). iqm is the mean of
    the middle half of the runs. From tolerance_low to tolerance_high most runs lie: the interval contains 90 % of all runs there
    could be with confidence tolerance_confidence, and a share tolerance_share of them with confidence 95 %. With fewer than 46
    runs it reaches from the lowest to the highest and attains less than 90 % with 95 % confidence. With a single run there are
    no intervals.
    """
    chosen = load_chosen(connection, study, options)
    rows = [_row(group, place, runs, options.seed) for group in chosen.groups for place, runs in group.runs.items()]
    whole = next(row for row in rows if row["num_runs"])  # it has all columns, in order
    data = pd.DataFrame(rows, columns=list(whole))
    intervals = "95 % intervals of the mean: Student, and bootstrap"
    notes = [f"study {study}: {chosen.subtitle()}; {intervals} (10,000 resamples, seed {options.seed})", *chosen.notes()]
    if (data["tolerance_confidence"] < 1 - ALPHA).any():
        low = data["tolerance_share"].min()
        notes.append(
            f"tolerance: lowest to highest run, which contains {low:.0%} of runs or more with confidence 95 %; "
            f"{BETA:.0%} needs {runs_needed(ALPHA, BETA)} runs"
        )
    if (data["bootstrap"] == "percentile bootstrap").any():
        notes.append("where the BCa bootstrap is undefined the interval is the percentile bootstrap's (column bootstrap)")
    return Table(data, notes, chosen.sql)


def _row(group: Chosen, environment: str, runs: Runs, seed: int) -> dict[str, Any]:
    scores = runs.scores
    if not len(scores):
        return _without_scores(group, environment, runs)
    student = interval(scores) if len(scores) > 1 else None
    bootstrap = _bootstrap(scores, seed) if len(scores) > 1 else None
    tolerance = tolerance_interval(scores, ALPHA, BETA) if len(scores) > 1 else None
    return {
        "agent": group.name,
        "environment": environment,
        "by": group.by,
        "num_runs": len(scores),
        "mean": student.value if student else float(scores.mean()),
        "low": student.low if student else np.nan,
        "high": student.high if student else np.nan,
        "bootstrap_low": bootstrap.low if bootstrap else np.nan,
        "bootstrap_high": bootstrap.high if bootstrap else np.nan,
        "median": float(np.median(scores)),
        "iqm": float(interquartile_mean(scores[None])),
        "minimum": float(scores.min()),
        "maximum": float(scores.max()),
        "tolerance_low": tolerance.low if tolerance else np.nan,
        "tolerance_high": tolerance.high if tolerance else np.nan,
        "tolerance_confidence": tolerance.attained_confidence if tolerance else np.nan,
        "tolerance_share": tolerance.attained_beta if tolerance else np.nan,
        "diverged": int(runs.diverged.sum()) + runs.num_dropped,
        "failed": runs.num_failed,
        "missing": runs.num_missing,
        "bootstrap": bootstrap.method if bootstrap else None,
        "setting": runs.setting,
    }


def _without_scores(group: Chosen, environment: str, runs: Runs) -> dict[str, Any]:
    return {
        "agent": group.name,
        "environment": environment,
        "by": group.by,
        "num_runs": 0,
        "diverged": runs.num_dropped,
        "failed": runs.num_failed,
        "missing": runs.num_missing,
        "bootstrap": None,
        "setting": runs.setting,
    }


def _bootstrap(scores: np.ndarray, seed: int) -> Estimate:
    try:
        return interval(scores, "bca", seed=seed)
    except UserError:
        return interval(scores, "percentile", seed=seed)
