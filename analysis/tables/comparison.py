"""Differences between agents, and between tuning regimes: with intervals first, and p-values corrected for their number."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import duckdb
import numpy as np
import pandas as pd

from analysis.chosen import (
    Chosen,
    ChosenRuns,
    load_chosen,
    normalize,
    restrict,
    same_seeds,
    studies_with_chosen_runs,
)
from analysis.figures.options import NoDataError, Options
from analysis.statistics.aggregates import aggregate_difference, improvement
from analysis.statistics.comparisons import compare
from analysis.statistics.corrections import correct
from analysis.tables.table import Table

TAKES = ("by", "score", "normalizer", "agents", "environments")
EVERYWHERE = "all"
"""In place of an environment: over all that both sides have."""

PERMUTATION = "paired permutation"
ENOUGH = 10
"""Pairs from which on the interval is a bootstrap: of fewer it is too narrow, and Student's holds (docs/statistics.md)."""

studies = studies_with_chosen_runs


@dataclass(frozen=True)
class _Contrast:
    """Two sides to compare on the environments of both. `family`: whose p-values are corrected together."""

    family: str
    by: str
    first: Chosen
    second: Chosen
    names: tuple[str, str]


def build(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> Table:
    """Differences of mean scores, the first side less the second: a row for each pair of agents under each tuning regime, and
    for each agent's settings tuned per environment less those tuned across environments (the price of one setting for all),
    on each environment in units of the score, and over all environments that both have (environment all) of normalized
    scores. Runs are those of the evaluation stage, or the tuning runs of a study without one; diverged runs count by the study's
    rule (worst return, or left out).
    Where both sides have the same seeds, runs are paired by seed: the 95 % interval is that of Student for the differences, from
    ten pairs on a percentile bootstrap of them (10,000 resamples of seeds, drawn jointly for all environments), and the p-value
    that of the paired permutation test; otherwise both are Welch's, and over all environments the interval is a stratified
    bootstrap
    without a p-value. p_superiority is the probability that a run of the first side is better than one of the second (ties half;
    over environments: the mean of each), cohens_d the difference in pooled standard deviations, p_holm the p-value after Holm's
    correction within its family of num_tests. Where both sides are the same runs the difference is 0 and nothing is tested.
    """
    every = load_chosen(connection, study, options)
    chosen = every.scored()
    contrasts = list(_contrasts(chosen))
    if not contrasts:
        raise NoDataError(
            f'study "{study}": a comparison needs two agents, or one tuned in both ways, with runs on one environment'
        )
    normalized, lacking = None, []
    try:
        normalized = normalize(connection, chosen, options.normalizer)
    except NoDataError as error:
        lacking = [f"no row over all environments: {error}"]
    rows = []
    for contrast in contrasts:
        rows += _on_each(contrast, chosen.score, options.seed)
        if normalized and len(contrast.first.runs) > 1:
            rows.append(_over_all(_find(normalized, contrast), normalized.normalizer, options.seed))
    _correct(rows)
    notes = [
        _headline(chosen, normalized, options.seed),
        *lacking,
        *(normalized or chosen).notes(),
        *_unscored(every),
        *_notes(rows),
    ]
    return Table(pd.DataFrame(rows), notes, chosen.sql)


def _headline(chosen: ChosenRuns, normalized: ChosenRuns | None, seed: int) -> str:
    over = f"; over all environments normalizer {normalized.normalizer}" if normalized else ""
    return f"study {chosen.study}: {chosen.subtitle()}{over}; 95 % intervals (10,000 resamples, seed {seed})"


def _notes(rows: list[dict[str, Any]]) -> list[str]:
    lines = []
    paired = [row["num_runs"] for row in rows if row["test"] == PERMUTATION]
    if paired and 2 / 2 ** min(paired) > 0.001:
        least = f"{2 / 2 ** min(paired):.3g}"
        lines.append(f"the paired permutation test of {min(paired)} runs gives no p-value below {least}, before its correction")
    if any(row["interval"] == "Welch" or row["interval"].startswith("stratified") for row in rows):
        lines.append("where the two sides have different seeds, runs are not paired")
    return lines


def _unscored(chosen: ChosenRuns) -> list[str]:
    return [f"{line}: no comparison there" for line in chosen.unscored]


def _contrasts(chosen: ChosenRuns) -> Iterator[_Contrast]:
    for by in chosen.regimes:
        for pair in itertools.combinations(chosen.of(by), 2):
            (first, second), environments = restrict(pair)
            if environments:
                yield _Contrast(f"agents, tuned {by.replace('-', ' ')}", by, first, second, (first.name, second.name))
    tuned, across = chosen.of("per-environment"), {group.name: group for group in chosen.of("across-environments")}
    for group in tuned:
        if group.name in across:
            (first, second), environments = restrict([group, across[group.name]])
            if environments:
                names = (f"{group.name}, per environment", f"{group.name}, across environments")
                yield _Contrast("regimes", "both", first, second, names)


def _find(normalized: ChosenRuns, contrast: _Contrast) -> _Contrast:
    """Return the same contrast of normalized scores."""
    known = {(group.by, group.name): group for group in normalized.groups}
    first, second = (known[side.by, side.name].on(side.runs) for side in (contrast.first, contrast.second))
    return _Contrast(contrast.family, contrast.by, first, second, contrast.names)


def _on_each(contrast: _Contrast, score: str, seed: int) -> list[dict[str, Any]]:
    rows = []
    for environment, runs in contrast.first.runs.items():
        other = contrast.second.runs[environment]
        same = runs.setting == other.setting and runs.seeds == other.seeds and contrast.family == "regimes"
        measured = _compared(runs.scores, other.scores, same_seeds([runs, other]), same, seed)
        means = {"first_mean": float(runs.scores.mean()), "second_mean": float(other.scores.mean())}
        rows.append(_row(contrast, environment, score, means, measured, f"{contrast.family}, each environment"))
    return rows


def _over_all(contrast: _Contrast, normalizer: str | None, seed: int) -> dict[str, Any]:
    sides = [contrast.first.runs, contrast.second.runs]
    first, second = ([runs.scores for runs in side.values()] for side in sides)
    means = {"first_mean": _mean(first), "second_mean": _mean(second)}
    if same_seeds(runs for side in sides for runs in side.values()):
        # one number a seed: its mean over environments, whose resamples are the joint ones of all environments
        x, y = np.mean(first, axis=0), np.mean(second, axis=0)
        same = contrast.family == "regimes" and all(sides[0][e].setting == sides[1][e].setting for e in sides[0])
        measured = _compared(x, y, True, same, seed)
    else:
        measured = _stratified(first, second, seed)
    superior = float(np.mean([improvement(x[None], y[None]) for x, y in zip(first, second, strict=True)]))
    measured |= {"p_superiority": superior}
    return _row(contrast, EVERYWHERE, normalizer, means, measured, f"{contrast.family}, over environments")


def _compared(x: np.ndarray, y: np.ndarray, paired: bool, same: bool, seed: int) -> dict[str, Any]:
    """Return what the columns from `num_runs` on say of two groups of runs; NaN where there are too few."""
    if same:
        return _measured(len(x), 0.0, 0.0, 0.0, "same runs", 0.5, 0.0)
    if min(len(x), len(y)) < 2:
        return _measured(
            min(len(x), len(y)), float(x.mean() - y.mean()), np.nan, np.nan, "none", float(improvement(x[None], y[None]))
        )
    paired_test, paired_name = ("paired_bootstrap", "paired bootstrap") if len(x) >= ENOUGH else ("paired_t", "paired Student")
    found = compare(x, y, paired_test if paired else "welch", seed=seed)
    tested = compare(x, y, "paired_permutation", seed=seed) if paired else found
    difference, effects = found.difference, found.effects
    return _measured(
        difference.num_runs,
        difference.value,
        difference.low,
        difference.high,
        paired_name if paired else "Welch",
        effects.probability_of_superiority,
        effects.cohen_d,
        tested.p_value,
        PERMUTATION if paired else "Welch",
    )


def _stratified(first: list[np.ndarray], second: list[np.ndarray], seed: int) -> dict[str, Any]:
    fewest = min(len(scores) for scores in (*first, *second))
    if fewest < 2:
        return _measured(fewest, _mean(first) - _mean(second), np.nan, np.nan, "none")
    found = aggregate_difference(first, second, "mean", seed=seed)
    return _measured(fewest, found.value, found.low, found.high, found.method)


def _measured(
    num_runs: int,
    difference: float,
    low: float,
    high: float,
    interval: str,
    superiority: float = np.nan,
    d: float = np.nan,
    p_value: float = np.nan,
    test: str = "",
) -> dict[str, Any]:
    return {
        "num_runs": num_runs,
        "difference": difference,
        "low": low,
        "high": high,
        "interval": interval,
        "p_superiority": superiority,
        "cohens_d": d,
        "p_value": p_value,
        "test": test,
    }


def _row(
    contrast: _Contrast, environment: str, scale: str | None, means: dict[str, float], measured: dict[str, Any], family: str
) -> dict[str, Any]:
    first, second = contrast.names
    identity = {"first": first, "second": second, "by": contrast.by, "environment": environment, "scale": scale}
    return {**identity, **measured, **means, "family": family}


def _correct(rows: list[dict[str, Any]]) -> None:
    """Add p-values corrected within each family, and how many tests it has."""
    for row in rows:
        row |= {"p_holm": np.nan, "num_tests": 0}
    for family in {row["family"] for row in rows}:
        tested = [row for row in rows if row["family"] == family and not np.isnan(row["p_value"])]
        for row, corrected in zip(tested, correct([row["p_value"] for row in tested], "holm"), strict=True):
            row |= {"p_holm": float(corrected), "num_tests": len(tested)}


def _mean(tasks: list[np.ndarray]) -> float:
    return float(np.mean([scores.mean() for scores in tasks]))
