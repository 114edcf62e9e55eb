"""Hyperparameter sensitivity and effective dimensionality of each agent (Adkins, Bowling and White 2024)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import duckdb
import pandas as pd

from analysis import scores
from analysis.figures.options import NoDataError, Options
from analysis.figures.scope import Scope, describe_progress, find_scope, studies_on_several_environments
from analysis.figures.sensitivity_data import run_scores
from analysis.statistics.estimate import Estimate, TooFewRunsError
from analysis.statistics.factors import find_factors
from analysis.statistics.hyperparameter_sensitivity import (
    ZERO_ANCHORED,
    Dimensionality,
    Sensitivity,
    effective_dimensionality,
    evaluated,
    plane_region,
    sensitivity,
)
from analysis.tables.table import Table
from analysis.tuning_scale import find_normalizer
from sweep.messages import UserError, counted
from sweep.normalizers import UndefinedNormalizerError

TAKES = ("score", "normalizer", "agents", "environments")
DEFAULT_NORMALIZER = "percentile"
RESAMPLES = 10_000
_FEW = 10


@dataclass(frozen=True)
class Measured:
    """What is known of an agent; `missing` says why `found` or `dimensionality` is None.

    `region`: where the agent lies relative to the reference agent. `evaluation`: Φ, tuned and compromise on evaluation seeds.
    """

    agent: str
    environments: tuple[str, ...]
    found: Sensitivity | None
    region: str = ""
    dimensionality: Dimensionality | None = None
    evaluation: tuple[Estimate, Estimate, Estimate] | None = None
    missing: tuple[str, ...] = ()
    joined: tuple[tuple[str, ...], ...] = ()
    num_left_out: int = 0


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies with tuning runs of an agent on several environments."""
    return studies_on_several_environments(connection)


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """For each agent, on normalized scores of tuning runs: `tuned`, the mean over environments of the best setting of each;
    `compromise`, the best single setting for all environments; `sensitivity` Φ, the difference; and the effective dimensionality,
    the smallest number of hyperparameters that reach 95 % of `tuned` when they alone are tuned to each environment, with
    the best score of each number. `region` is relative to the reference agent, SAC or the first. The percentile normalizer
    unless another is asked for: 0 is the 5th, 1 the 95th percentile of all settings of all agents on an environment. 95 %
    percentile intervals over 10,000 bootstrap resamples of the seeds, the same for all settings and environments; 1,000 for the
    dimensionality. Diverged runs count by the study's rule (worst return, or left out); where
    any is left out settings have different seeds, which is refused. All of these are maxima over noisy means: Φ is above
    0 by luck alone. The columns `evaluated_…` are without that luck: the settings chosen per environment and across
    environments by the study's selection, on evaluation seeds.
    """
    scope = find_scope(connection, study, options)
    normalizer = check_normalizer(options)
    measured = measure(connection, scope, normalizer, options.seed, with_dimensionality=True)
    data = rows(scope, normalizer, measured)
    return Table(data, notes(scope, normalizer, measured, options.seed), run_scores(scope, "tune", "evaluate"))


def check_normalizer(options: Options) -> str:
    """Return the normalizer that is asked for. Raises UserError for the thesis', whose scores have no common scale."""
    name = options.normalizer or DEFAULT_NORMALIZER
    if name not in ZERO_ANCHORED:
        raise UserError(
            f'normalizer "{name}": a sensitivity is a difference of scores averaged over environments, and 95 % of one; the '
            "thesis' normalizer has no lower end, and a spread of its own on each environment, so that one of them decides "
            f"alone. Choose one of {', '.join(ZERO_ANCHORED)}"
        )
    return name


def measure(
    connection: duckdb.DuckDBPyConnection, scope: Scope, normalizer: str, seed: int, with_dimensionality: bool = False
) -> list[Measured]:
    """Return what is known of each agent, in alphabetical order. Raises NoDataError where nothing is of any.

    Environments on which the normalizer is undefined, because settings do not differ there, are left out.
    """
    undefined = _undefined(connection, scope, normalizer)
    known = [_one(connection, scope, agent, normalizer, undefined, seed, with_dimensionality) for agent in scope.agents]
    if not any(one.found for one in known):
        reasons = "\n".join(f"  {one.agent}: {'; '.join(one.missing)}" for one in known)
        raise NoDataError(f'study "{scope.study}" has no sensitivity to show:\n{reasons}')
    reference = find_reference(known)
    return [replace(one, region="reference" if one is reference else _region(one, reference)) for one in known]


def find_reference(measured: Sequence[Measured]) -> Measured:
    """Return the agent that others are compared with: SAC if it is there, or the first."""
    known = [one for one in measured if one.found]
    return next((one for one in known if one.agent == "SAC"), known[0])


def rows(scope: Scope, normalizer: str, measured: Sequence[Measured]) -> pd.DataFrame:
    """Return a row per agent."""
    return pd.DataFrame([_row(scope.study, normalizer, one) for one in measured if one.found])


def notes(scope: Scope, normalizer: str, measured: Sequence[Measured], seed: int) -> list[str]:
    """Return lines: the study, the intervals, the reference, then of each agent what is left out, missing or joined."""
    lines = [
        f"study {scope.study}: {scope.subtitle()}; normalizer {normalizer}; intervals: 95 %, percentile bootstrap of the seeds, "
        f"{RESAMPLES:,} resamples, seed {seed}",
        f"regions are relative to {find_reference(measured).agent}",
    ]
    if len({one.environments for one in measured if one.found}) > 1:
        lines.append("warning: agents are tuned on different environments: their points are not comparable")
    for one in measured:
        if one.found:
            lines.append(f"{one.agent}: {counted(one.found.num_settings, 'setting')} on {', '.join(one.environments)}")
        if one.num_left_out:
            lines.append(
                f"{one.agent}: {counted(one.num_left_out, 'setting')} left out: without all runs, or not on all environments"
            )
        if one.evaluation:
            phi = one.evaluation[0]
            lines.append(
                f"{one.agent}: on {phi.num_runs} evaluation seeds, without the luck of a choice: sensitivity {phi.value:.4g} in "
                f"[{phi.low:.4g}, {phi.high:.4g}]"
            )
        lines += [f"{one.agent}: {' & '.join(names)} always vary together: one hyperparameter here" for names in one.joined]
        lines += [f"{one.agent}: {reason}" for reason in one.missing]
    if scope.seeds < _FEW:
        lines.append(f"warning: bootstrap intervals of {counted(scope.seeds, 'seed')} are too narrow; ten are customary")
    return [*lines, *describe_progress(scope)]


def _one(
    connection: duckdb.DuckDBPyConnection,
    scope: Scope,
    agent: str,
    normalizer: str,
    undefined: Mapping[str, str],
    seed: int,
    with_dimensionality: bool,
) -> Measured:
    planned = [place for place in scope.environments if (agent, place) in scope.progress]
    environments = tuple(place for place in planned if place not in undefined)
    reasons = tuple(f"left out: {undefined[place]}" for place in planned if place in undefined)
    if len(environments) < 2:
        lacking = f"a sensitivity needs several environments, and there is {'one' if environments else 'none'}"
        return Measured(agent, environments, None, missing=(lacking, *reasons))
    try:
        loaded = scores.load_across(
            connection, scope.study, agent, score=scope.score, normalizer=normalizer, environments=environments
        )
        kept = loaded.without_incomplete()
        if kept.dropped.any():
            raise UserError(
                "a sensitivity needs the same seeds of all settings, and the study's rule leaves out runs that diverged"
            )
        found = sensitivity(kept.values, resamples=RESAMPLES, seed=seed)
    except TooFewRunsError as error:
        return Measured(agent, environments, None, missing=(f"{error}: needs at least two tuning seeds",))
    except UserError as error:
        return Measured(agent, environments, None, missing=(str(error),))
    missing, dimensionality, evaluation = [*reasons], None, None
    # of the planned grid: among settings that happen to have their runs, hyperparameters may vary together by chance
    factors = find_factors(kept.hypers, planned=loaded.hypers)
    joined = tuple(names for names in factors.names if len(names) > 1)
    if with_dimensionality:
        try:
            dimensionality = effective_dimensionality(
                kept.values, kept.hypers, planned=loaded.hypers, normalizer=normalizer, seed=seed
            )
        except UserError as error:
            missing.append(str(error))
    try:
        evaluation = _evaluation(connection, scope, agent, normalizer, environments, seed)
    except UserError as error:
        missing.append(f"no sensitivity on evaluation seeds: {error}")
    left_out = loaded.num_left_out + len(loaded.settings) - len(kept.settings)
    return Measured(
        agent,
        environments,
        found,
        dimensionality=dimensionality,
        evaluation=evaluation,
        missing=tuple(missing),
        joined=joined if with_dimensionality else (),
        num_left_out=left_out,
    )


def _undefined(connection: duckdb.DuckDBPyConnection, scope: Scope, normalizer: str) -> dict[str, str]:
    """Return environment → why the normalizer is undefined there."""
    found = {}
    for place in scope.environments:
        try:
            find_normalizer(connection, scope.study, scope.score, normalizer, [place])[0].normalize(place, [0.0])
        except UndefinedNormalizerError as error:
            found[place] = str(error)
        except UserError:
            continue  # no setting has all of its runs: said of the agents
    return found


def _region(one: Measured, reference: Measured) -> str:
    if not one.found or not reference.found:
        return ""
    points = [(known.sensitivity.value, known.tuned.value) for known in (one.found, reference.found)]
    return plane_region(*points[0], *points[1])


def _evaluation(
    connection: duckdb.DuckDBPyConnection, scope: Scope, agent: str, normalizer: str, environments: tuple[str, ...], seed: int
) -> tuple[Estimate, Estimate, Estimate]:
    """Return Φ, tuned and compromise on evaluation seeds. Raises UserError where there is no choice, or runs are missing."""
    runs = scores.load_evaluated(
        connection, scope.study, agent, score=scope.score, normalizer=normalizer, environments=environments
    )
    lacking = [place for place in environments if place not in runs.environments]
    if lacking:
        raise UserError(f"nothing is chosen on {', '.join(lacking)}")
    if runs.num_dropped:
        raise UserError("both choices need the same seeds, and the study's rule leaves out runs that diverged")
    places = [runs.environments.index(place) for place in environments]
    return evaluated(runs.tuned[places], runs.compromise[places], resamples=RESAMPLES, seed=seed)


def _row(study: str, normalizer: str, one: Measured) -> dict[str, Any]:
    assert one.found
    row: dict[str, Any] = {"study": study, "agent": one.agent, "normalizer": normalizer, "region": one.region}
    row |= _columns("sensitivity", one.found.sensitivity)
    row |= _columns("tuned", one.found.tuned)
    row |= _columns("compromise", one.found.compromise)
    if one.dimensionality:
        known = one.dimensionality
        row["dimensionality"] = known.dimensionality
        row["dimensionality_interpolated"] = known.interpolated
        row["dimensionality_probability"] = float(known.probabilities[known.dimensionality])
        row["best_of_each_number"] = "; ".join(
            f"{' + '.join(subset) or 'none'}: {score:.4g}"
            for subset, score in zip(known.best_subsets, known.best_scores, strict=True)
        )
    for name, estimate in zip(("sensitivity", "tuned", "compromise"), one.evaluation or (), strict=bool(one.evaluation)):
        row |= _columns(f"evaluated_{name}", estimate)
    row |= {
        "num_environments": len(one.environments),
        "num_settings": one.found.num_settings,
        "num_seeds": one.found.num_runs,
        "num_evaluation_seeds": one.evaluation[0].num_runs if one.evaluation else None,
    }
    return row


def _columns(name: str, estimate: Estimate) -> dict[str, float]:
    return {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}
