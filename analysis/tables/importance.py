"""Importance of hyperparameters: the share of the variance between settings that each one explains, and each pair."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import duckdb
import numpy as np
import pandas as pd

from analysis import scores
from analysis.figures.options import NoDataError, Options
from analysis.figures.scope import FEW_SEEDS, Scope, describe_progress, find_scope
from analysis.figures.sensitivity_data import run_scores
from analysis.statistics.factors import find_factors
from analysis.statistics.importance import Importance, decompose
from analysis.tables.table import Table
from sweep.messages import UserError, counted

TAKES = ("score", "agents", "environments")
RESAMPLES = 1_000
_NAMED = 5  # settings that a message names


@dataclass(frozen=True)
class Measured:
    """An agent on an environment: its importance, or None and why there is none.

    `joined`: hyperparameters that do not vary independently of one another and are one factor.
    """

    agent: str
    environment: str
    importance: Importance | None
    missing: str = ""
    joined: tuple[tuple[str, ...], ...] = ()

    @property
    def where(self) -> str:
        """`SAC on Pendulum-CA`."""
        return f"{self.agent} on {self.environment}"


def studies(connection: duckdb.DuckDBPyConnection, options: Options) -> list[str]:
    """Return the studies with tuning runs that sweep a hyperparameter."""
    rows = connection.execute(
        """
        SELECT DISTINCT study
        FROM hyperparameters
        WHERE is_swept AND study IN (SELECT study FROM settings WHERE stage = 'tune' AND num_seeds > 0)
        ORDER BY study
        """
    ).fetchall()
    return [row[0] for row in rows]


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """Share of the variance between the means of an agent's settings on an environment that is due to each hyperparameter alone,
    to each pair beyond that, and to all higher interactions (exact functional ANOVA on the full grid). The variance of
    means that noise alone gives, σ²/n, is removed in proportion to the degrees of freedom: a share may be negative, which
    means no effect that these runs can show. 95 % percentile intervals over 1,000 bootstrap resamples of the tuning seeds,
    the same for all settings. Diverged runs count by the study's rule (worst return, or left out); where any
    is left out settings have different seeds, which is refused. Hyperparameters that the study did not vary independently (a
    `zip`) are one factor. An incomplete grid is refused.
    """
    scope = find_scope(connection, study, options)
    measured = measure(connection, scope, options.seed)
    return Table(rows(study, measured), notes(scope, measured, options.seed), run_scores(scope))


def measure(connection: duckdb.DuckDBPyConnection, scope: Scope, seed: int) -> list[Measured]:
    """Return the importance for each agent on each environment, in alphabetical order. Raises NoDataError where there is none."""
    measured = [_one(connection, scope, agent, environment, seed) for agent, environment in sorted(scope.progress)]
    if not any(known.importance for known in measured):
        reasons = "\n".join(f"  {known.where}: {known.missing}" for known in measured)
        raise NoDataError(f'study "{scope.study}" has no importance to show:\n{reasons}')
    return measured


def rows(study: str, measured: Sequence[Measured]) -> pd.DataFrame:
    """Return a row per agent, environment and component."""
    return pd.DataFrame(
        {
            "study": study,
            "agent": known.agent,
            "environment": known.environment,
            "component": component.label,
            "order": len(component.factors) or None,
            "share": component.share.value,
            "share_low": component.share.low,
            "share_high": component.share.high,
            "variance": component.variance,
            "degrees_of_freedom": component.degrees_of_freedom,
            "num_settings": known.importance.num_settings,
            "num_seeds": known.importance.num_runs,
        }
        for known in measured
        if known.importance
        for component in known.importance.components
    ).astype({"order": "Int64"})


def notes(scope: Scope, measured: Sequence[Measured], seed: int) -> list[str]:
    """Return lines: the study, the intervals, then of each panel what is joined, negative, undefined or missing."""
    lines = [
        f"study {scope.study}: {scope.subtitle()}; shares of the variance between settings, noise removed; intervals: 95 %, "
        f"percentile bootstrap of the seeds, {RESAMPLES:,} resamples, seed {seed}"
    ]
    if (fewest := min((known.importance.num_runs for known in measured if known.importance), default=FEW_SEEDS)) < FEW_SEEDS:
        lines.append(f"{counted(fewest, 'seed')}: intervals say little, and may lie beside their own estimate")
    for known in measured:
        lines += [f"{known.where}: {' & '.join(names)} do not vary independently: one factor" for names in known.joined]
        found = known.importance
        if found is None:
            lines.append(f"{known.where}: left out: {known.missing}")
        elif not found.shares_defined:
            lines.append(f"{known.where}: settings differ by no more than noise: shares are undefined")
        elif found.negative:
            lines.append(
                f"{known.where}: below 0, no effect that {counted(found.num_runs, 'seed')} can show: " + ", ".join(found.negative)
            )
    return [*lines, *describe_progress(scope)]


def crossed_groups(hypers: Mapping[str, Sequence[Any]]) -> tuple[tuple[str, ...], ...]:
    """Return groups of hyperparameters (two names at least) that a study, by its planned settings, did not cross, as in a `zip`.

    Two are not crossed where so few pairs of values are planned, a + b − 1 at most of a · b, that no four need form a square:
    nothing could tell their effects apart. A grid that only lacks some pairs is none.
    """
    names = list(hypers)
    group = {name: {name} for name in names}
    for index, first in enumerate(names):
        for second in names[index + 1 :]:
            pairs = set(zip(hypers[first], hypers[second], strict=True))
            sizes = len(set(hypers[first])), len(set(hypers[second]))
            if min(sizes) > 1 and len(pairs) < sum(sizes):
                merged = group[first] | group[second]
                group.update(dict.fromkeys(merged, merged))
    found = {tuple(name for name in names if name in group[first]): None for first in names}
    return tuple(known for known in found if len(known) > 1)


def _one(connection: duckdb.DuckDBPyConnection, scope: Scope, agent: str, environment: str, seed: int) -> Measured:
    try:
        loaded = scores.load(connection, scope.study, agent, environment, scope.score)
        if loaded.dropped.any():
            return Measured(agent, environment, None, _describe_dropped(loaded))
        if not loaded.complete:
            return Measured(agent, environment, None, _describe_incomplete(loaded))
        found, joined = _decompose(loaded, seed)
    except UserError as error:
        return Measured(agent, environment, None, str(error))
    return Measured(agent, environment, found, "", joined)


def _decompose(loaded: scores.SettingScores, seed: int) -> tuple[Importance, tuple[tuple[str, ...], ...]]:
    """Decompose on the grid as it is, or where it is not full with what varies together as one factor, if others remain."""
    try:
        return decompose(loaded.values, loaded.hypers, resamples=RESAMPLES, seed=seed), ()
    except UserError:
        joined = crossed_groups(loaded.hypers)
        if not joined or len(find_factors(loaded.hypers, joined).names) < 2:
            raise
    return decompose(loaded.values, loaded.hypers, together=joined, resamples=RESAMPLES, seed=seed), joined


def _describe_dropped(loaded: scores.SettingScores) -> str:
    lacking = int(loaded.dropped.any(axis=1).sum())
    return (
        f"{lacking:,} of {counted(len(loaded.settings), 'setting')} lack runs that diverged, which the study's rule leaves out, "
        "and an importance needs the same seeds of all settings"
    )


def _describe_incomplete(loaded: scores.SettingScores) -> str:
    """Return which settings lack runs."""
    lacking = np.flatnonzero(~np.isfinite(loaded.values).all(axis=1))
    named = [", ".join(f"{name} = {values[h]}" for name, values in loaded.hypers.items()) for h in lacking[:_NAMED]]
    more = "; …" if len(lacking) > _NAMED else ""
    return (
        f"{len(lacking):,} of {counted(len(loaded.settings), 'setting')} lack runs, and an importance needs all: "
        f"{'; '.join(named)}{more}; `sweep launch` trains them"
    )
