"""How certain the choice of settings is, and how much too good the score of the chosen one looks."""

from collections.abc import Sequence
from typing import Any

import duckdb
import numpy as np
import pandas as pd

from analysis import scores
from analysis.figures.options import REGIMES, NoDataError, Options
from analysis.figures.scope import Scope, describe_progress, find_rule, find_scope
from analysis.figures.sensitivity_data import run_scores
from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.intervals import interval
from analysis.statistics.seed_resampling import winners
from analysis.statistics.selection_uncertainty import bootstrap_selection, maximization_bias
from analysis.tables.table import Table
from sweep.messages import UserError, counted

TAKES = ("by", "score", "normalizer", "agents", "environments")
RESAMPLES = 1_000
_FEW = 10


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies with tuning runs."""
    rows = connection.execute(
        "SELECT DISTINCT study FROM settings WHERE stage = 'tune' AND num_seeds > 0 ORDER BY study"
    ).fetchall()
    return [row[0] for row in rows]


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """The choice of a setting, repeated on resampled runs: per environment on the study's score, and across environments on its
    mean normalized score. `num_settings` compared on `num_seeds` tuning seeds each; the winner `setting`, the share of 1,000
    bootstrap resamples that it wins, and the number of settings that win at least 5 % (`uncertainty_set`); its `lead` on the
    runner-up with a 95 % paired percentile interval. Its `tuning_mean` is too good: by how much, the `bias_…` columns estimate,
    from the bootstrap (too little where settings are alike), from choosing on half of the seeds and scoring on the others (that
    of a choice on half as many runs) and as the largest of so many equally good settings with normal noise would have it (an
    upper end). `evaluation_mean` is the winner's mean on fresh seeds, with a 95 % Student interval. Seeds are resampled, the
    same for all settings. Diverged runs count by the study's rule (worst return, or left out); where any is left out settings
    have different seeds, and there are neither probabilities nor intervals. Settings that lack a run are left out.
    """
    scope = find_scope(connection, study, options)
    regimes = [options.by] if options.by else list(REGIMES)
    normalizer = options.normalizer or find_rule(connection, study, "normalizer")
    rows: list[dict[str, Any]] = []
    lines: list[str] = []
    if REGIMES[0] in regimes:
        for agent, environment in sorted(scope.progress):
            rows += _try(
                lines, f"{agent} on {environment}", _per_environment, connection, scope, agent, environment, options.seed
            )
    if REGIMES[1] in regimes:
        for agent in scope.agents:
            label = f"{agent} across environments"
            rows += _try(lines, label, _across, connection, scope, agent, normalizer, options.seed)
    if not rows:
        raise NoDataError(f'study "{study}" has no choice to show:\n' + "\n".join(f"  {line}" for line in lines))
    head = f"study {study}: {scope.subtitle()}" + (
        f"; normalizer {normalizer} across environments" if REGIMES[1] in regimes else ""
    )
    lines.insert(0, f"{head}; {RESAMPLES:,} resamples of the seeds, seed {options.seed}")
    lines += _warnings(rows)
    return Table(pd.DataFrame(rows), [*lines, *describe_progress(scope)], run_scores(scope, "tune", "evaluate"))


def _try(lines: list[str], label: str, measure: Any, *arguments: Any) -> list[dict[str, Any]]:
    """Return the one row that `measure` gives, or none, noting what is left out, and why."""
    try:
        row, left_out = measure(*arguments)
    except UserError as error:
        lines.append(f"{label}: {error}")
        return []
    if left_out:
        lines.append(f"{label}: {counted(left_out, 'setting')} left out: without all runs, or not on all environments")
    if np.isnan(row["win_probability"]) and row["num_settings"] > 1:
        reason = (
            "one tuning seed" if row["num_seeds"] == 1 else "diverged runs are left out, so that settings differ in their seeds"
        )
        lines.append(f"{label}: {reason}: nothing to resample, so neither probabilities nor intervals")
    return [row]


def _per_environment(
    connection: duckdb.DuckDBPyConnection, scope: Scope, agent: str, environment: str, seed: int
) -> tuple[dict[str, Any], int]:
    loaded = scores.load(connection, scope.study, agent, environment, scope.score)
    kept = loaded.without_incomplete()
    row = {"study": scope.study, "by": REGIMES[0], "agent": agent, "environment": environment}
    row |= _choice(kept.values, kept.means, kept.settings, seed)
    row |= _evaluation(_evaluation_runs(connection, scope, agent, environment, row["setting"]))
    return row, len(loaded.settings) - len(kept.settings)


def _across(
    connection: duckdb.DuckDBPyConnection, scope: Scope, agent: str, normalizer: str, seed: int
) -> tuple[dict[str, Any], int]:
    environments = [place for place in scope.environments if (agent, place) in scope.progress]
    if len(environments) < 2:
        raise UserError("a choice across environments needs several, and there is one")
    loaded = scores.load_across(
        connection, scope.study, agent, score=scope.score, normalizer=normalizer, environments=environments
    )
    kept = loaded.without_incomplete()
    names = [" ".join(sorted(set(hashes))) for hashes in kept.settings]
    row: dict[str, Any] = {
        "study": scope.study,
        "by": REGIMES[1],
        "agent": agent,
        "environment": f"{len(environments)} environments",
    }
    row |= _choice(kept.values.mean(axis=0), kept.means.mean(axis=0), names, seed)
    chosen = dict(zip(kept.environments, kept.settings[names.index(row["setting"])], strict=True))
    evaluated = _evaluation_across(connection, scope, agent, normalizer, chosen)
    row |= _evaluation(evaluated.values.mean(axis=0) if evaluated else np.array([]))
    if evaluated and evaluated.dropped.any():  # environments differ in their seeds: no mean of a seed over all of them
        row["evaluation_mean"] = float(scores.mean_scores(evaluated.values).mean())
        row["evaluation_low"] = row["evaluation_high"] = np.nan
    return row, loaded.num_left_out + len(loaded.settings) - len(kept.settings)


def _choice(values: np.ndarray, means: np.ndarray, names: Sequence[str], seed: int) -> dict[str, Any]:
    """Return the columns of a choice among settings [H, S] by their means [H], with NaN where there is nothing to resample.

    There is nothing where there is one seed, or settings have different ones because diverged runs are left out (NaN).
    """
    winner = int(winners(means))
    row: dict[str, Any] = {
        "num_settings": len(values),
        "num_seeds": values.shape[1],
        "setting": names[winner],
        "win_probability": np.nan,
        "uncertainty_set": None,
        "runner_up": None,
        **dict.fromkeys(("lead", "lead_low", "lead_high"), np.nan),
        "tuning_mean": float(means[winner]),
        **dict.fromkeys(("bias_bootstrap", "bias_split_half", "bias_gaussian", "noise"), np.nan),
    }
    if not np.isfinite(values).all():
        return row
    try:
        found = bootstrap_selection(values, resamples=RESAMPLES, seed=seed)
        bias = maximization_bias(values, resamples=RESAMPLES, seed=seed)
    except TooFewRunsError:
        return row
    row |= {"win_probability": float(found.probabilities[winner]), "uncertainty_set": len(found.uncertainty_set)}
    if found.runner_up is not None and found.lead is not None:
        row["runner_up"] = names[found.runner_up]
        row |= {"lead": found.lead.value, "lead_low": found.lead.low, "lead_high": found.lead.high}
        row |= {"bias_bootstrap": bias.bootstrap, "bias_split_half": bias.split_half, "bias_gaussian": bias.gaussian}
        row["noise"] = bias.noise
    return row


def _evaluation_runs(
    connection: duckdb.DuckDBPyConnection, scope: Scope, agent: str, environment: str, setting: str
) -> np.ndarray:
    """Return the scores of a setting's evaluation runs, empty where there are none."""
    rows = connection.execute(
        f"""
        SELECT {scope.score}
        FROM run_scores
        WHERE study = ? AND stage = 'evaluate' AND agent = ? AND environment = ? AND setting = ?
        ORDER BY seed
        """,
        [scope.study, agent, environment, setting],
    ).fetchall()
    return np.array([score for (score,) in rows if score is not None], dtype=float)


def _evaluation_across(
    connection: duckdb.DuckDBPyConnection, scope: Scope, agent: str, normalizer: str, chosen: dict[str, str]
) -> scores.ChoiceScores | None:
    """Return the normalized scores of the evaluation runs, None where there are none or the study evaluated another choice."""
    frozen = connection.execute(
        'SELECT environment, setting FROM selections WHERE study = ? AND agent = ? AND "by" = ?', [scope.study, agent, REGIMES[1]]
    ).fetchall()
    if dict(frozen) != chosen:
        return None
    try:
        return scores.load_choice(connection, scope.study, agent, REGIMES[1], score=scope.score, normalizer=normalizer)
    except UserError:
        return None


def _evaluation(runs: np.ndarray) -> dict[str, Any]:
    runs = runs[np.isfinite(runs)]
    row: dict[str, Any] = {
        "evaluation_mean": float(runs.mean()) if len(runs) else np.nan,
        "evaluation_low": np.nan,
        "evaluation_high": np.nan,
        "num_evaluation_seeds": len(runs),
    }
    if len(runs) > 1:
        estimate = interval(runs, method="student")
        row |= {"evaluation_low": estimate.low, "evaluation_high": estimate.high}
    return row


def _warnings(rows: Sequence[dict[str, Any]]) -> list[str]:
    lines = []
    unsure = [f"{row['agent']} on {row['environment']}" for row in rows if (row["uncertainty_set"] or 1) > 1]
    if unsure:
        lines.append(f"warning: several settings win at least 5 % of the resamples: {', '.join(unsure)}")
    if not any(row["num_evaluation_seeds"] for row in rows):
        lines.append("no evaluation runs: tuning means are too good to be shown as performance")
    fewest = min(row["num_seeds"] for row in rows)
    if 1 < fewest < _FEW:
        lines.append(f"warning: {counted(fewest, 'seed')}: bootstrap intervals are too narrow, and probabilities coarse")
    return lines
