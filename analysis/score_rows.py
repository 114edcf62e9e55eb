"""What `scores` makes arrays of: planned settings with their hyperparameters, and the scores of runs by setting and seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import duckdb
import numpy as np

from sweep import schema
from sweep.messages import UserError, suggestion


@dataclass(frozen=True)
class PlannedSettings:
    """Hashes [H], ascending, and name → the value of each, of the hyperparameters that apply to any of them."""

    hashes: tuple[str, ...]
    hypers: dict[str, list[Any]]


def check_known(what: str, value: str, choices: Sequence[str]) -> None:
    if value not in choices:
        raise UserError(f'{what} "{value}" is not known; {suggestion(value, choices)}')


def check_place(
    connection: duckdb.DuckDBPyConnection, study: str, stage: str, agent: str, environment: str | None = None
) -> None:
    check_known("study", study, read_column(connection, "SELECT DISTINCT study FROM members"))
    places = connection.execute(
        "SELECT DISTINCT agent, environment FROM members WHERE study = ? AND stage = ?", [study, stage]
    ).fetchall()
    if not places:
        raise UserError(f'study "{study}" has no {stage} trial')
    check_known(f"study {study}: agent", agent, sorted({name for name, _ in places}))
    if environment is not None:
        check_known(f"{agent} in study {study}: environment", environment, sorted({name for of, name in places if of == agent}))


def read_column(connection: duckdb.DuckDBPyConnection, query: str, values: Sequence[Any] = ()) -> list[str]:
    return [row[0] for row in connection.execute(query, list(values)).fetchall()]


def planned_settings(
    connection: duckdb.DuckDBPyConnection, study: str, stage: str, agent: str, environments: Sequence[str]
) -> dict[str, PlannedSettings]:
    """Return environment → its settings."""
    found = connection.execute(
        """
        SELECT DISTINCT ON (environment, setting) *
        FROM members
        WHERE study = ? AND stage = ? AND agent = ? AND list_contains(?, environment)
        ORDER BY environment, setting
        """,
        [study, stage, agent, list(environments)],
    )
    names = [column[0] for column in found.description]
    rows: dict[str, list[dict[str, Any]]] = {environment: [] for environment in environments}
    for row in found.fetchall():
        known = dict(zip(names, row, strict=True))
        rows[known["environment"]].append(known)
    return {
        environment: PlannedSettings(
            tuple(row["setting"] for row in here),
            {
                name: [tuple(row[name]) if isinstance(row[name], list) else row[name] for row in here]
                for name in names
                if name not in schema.MEMBERS.names and any(row[name] is not None for row in here)
            },
        )
        for environment, here in rows.items()
    }


def run_values(
    connection: duckdb.DuckDBPyConnection, study: str, stage: str, agent: str, score: str, settings: Mapping[str, Sequence[str]]
) -> tuple[tuple[int, ...], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the seeds, ascending, environment → scores [H, S] of these settings (NaN: none), which are left out."""
    rows = connection.execute(
        f"""
        SELECT environment, setting, seed, {score}, is_dropped
        FROM run_scores
        WHERE study = ? AND stage = ? AND agent = ? AND list_contains(?, environment)
        """,
        [study, stage, agent, list(settings)],
    ).fetchall()
    seeds = tuple(sorted({seed for _, _, seed, *_ in rows}))
    column = {seed: s for s, seed in enumerate(seeds)}
    places = {(environment, setting): h for environment, here in settings.items() for h, setting in enumerate(here)}
    values = {environment: np.full((len(here), len(seeds)), np.nan) for environment, here in settings.items()}
    dropped = {environment: np.zeros(here.shape, bool) for environment, here in values.items()}
    for environment, setting, seed, value, is_dropped in rows:
        if (environment, setting) in places:
            place = places[environment, setting], column[seed]
            values[environment][place] = np.nan if value is None else value
            dropped[environment][place] = is_dropped
    return seeds, values, dropped
