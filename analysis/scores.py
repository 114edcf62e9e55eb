"""Scores of settings as arrays, for the statistics: one agent on one environment, across environments, and on evaluation seeds.

Settings are in the order of their hashes, so that of equally good ones the first is that which a selection takes. A run that
diverged has the worst return of the environment (view `study_trials`); one that is missing, failed or completed no episode is
NaN.

Across environments the candidates are those of the selection: a setting on an environment where a hyperparameter does not apply
(GreedyAC's entropy scale with discrete actions) belongs to every candidate that agrees on the others.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import duckdb
import numpy as np

from analysis.tuning_scale import find_normalizer, normalize
from sweep import schema
from sweep.messages import UserError, suggestion
from sweep.selection import ACROSS_ENVIRONMENTS, PER_ENVIRONMENT

SCORES = ("episode_mean", "step_mean", "final_mean")


@dataclass(frozen=True)
class SettingScores:
    """Scores `values` [H, S] of the settings of an agent on an environment, NaN where there is none.

    `hypers`: name → the value of each setting, of those that vary between settings; lists are tuples, None where one does not
    apply.
    """

    agent: str
    environment: str
    score: str
    stage: str
    seeds: tuple[int, ...]
    settings: tuple[str, ...]
    hypers: dict[str, tuple[Any, ...]]
    values: np.ndarray

    @property
    def complete(self) -> bool:
        """Whether every run has a score."""
        return bool(np.isfinite(self.values).all())

    def without_incomplete(self) -> "SettingScores":
        """Return the settings all of whose runs have a score. Raises UserError where none has."""
        kept = np.flatnonzero(np.isfinite(self.values).all(axis=1))
        if not len(kept):
            raise UserError(f"{self.agent} on {self.environment}: no setting has all of its runs and their scores")
        return replace(
            self,
            settings=tuple(self.settings[h] for h in kept),
            hypers=_varying({name: [values[h] for h in kept] for name, values in self.hypers.items()}),
            values=self.values[kept],
        )


@dataclass(frozen=True)
class AcrossScores:
    """Normalized scores `values` [E, H, S] of an agent's candidates, NaN where there is none.

    `settings` [H]: the hash of each candidate's setting on each of the environments. `hypers` as in SettingScores. `frozen`:
    whether the normalizer's constants are those of the study's selection, and not of the tuning runs as they are now.
    `num_left_out`: settings, over all environments, that belong to no candidate because another environment has none that agrees.
    """

    agent: str
    environments: tuple[str, ...]
    score: str
    normalizer: str
    frozen: bool
    seeds: tuple[int, ...]
    settings: tuple[tuple[str, ...], ...]
    hypers: dict[str, tuple[Any, ...]]
    values: np.ndarray
    num_left_out: int

    @property
    def complete(self) -> bool:
        """Whether every run has a score."""
        return bool(np.isfinite(self.values).all())

    def without_incomplete(self) -> "AcrossScores":
        """Return the candidates all of whose runs, on all environments, have a score. Raises UserError where none has."""
        kept = np.flatnonzero(np.isfinite(self.values).all(axis=(0, 2)))
        if not len(kept):
            raise UserError(f"{self.agent}: no setting has all of its runs and their scores on {', '.join(self.environments)}")
        return replace(
            self,
            settings=tuple(self.settings[h] for h in kept),
            hypers=_varying({name: [values[h] for h in kept] for name, values in self.hypers.items()}),
            values=self.values[:, kept],
        )


@dataclass(frozen=True)
class EvaluatedScores:
    """Normalized scores [E, S] on evaluation seeds of the settings chosen per environment (`tuned`) and across (`compromise`)."""

    agent: str
    environments: tuple[str, ...]
    score: str
    normalizer: str
    seeds: tuple[int, ...]
    tuned: np.ndarray
    compromise: np.ndarray


def load(
    connection: duckdb.DuckDBPyConnection,
    study: str,
    agent: str,
    environment: str,
    score: str = "episode_mean",
    stage: str = "tune",
) -> SettingScores:
    """Return the scores of the settings of an agent on an environment.

    Raises UserError for an unknown study, agent, environment, score or stage, and where no run has a score yet.
    """
    _one_of("score", score, SCORES)
    _one_of("stage", stage, schema.STAGES)
    _check_place(connection, study, stage, agent, environment)
    known = _settings(connection, study, stage, agent, [environment])[environment]
    seeds, found = _values(connection, study, stage, agent, score, {environment: known.hashes})
    values = found[environment]
    if not np.isfinite(values).any():
        raise UserError(f'study "{study}": {agent} on {environment} has no {score} of a {stage} run yet')
    return SettingScores(agent, environment, score, stage, seeds, known.hashes, _varying(known.hypers), values)


def load_across(
    connection: duckdb.DuckDBPyConnection,
    study: str,
    agent: str,
    *,
    score: str = "episode_mean",
    normalizer: str | None = None,
    environments: Sequence[str] | None = None,
) -> AcrossScores:
    """Return the normalized tuning scores of an agent's candidates on the environments (default: all that it is tuned on).

    `normalizer` None is that of the study's selection, and the thesis' where there is none. Constants are those of the selection
    where it was made with this normalizer and score; otherwise of the tuning runs. Raises UserError as `load`, where no candidate
    is on all environments, and where the normalizer is undefined.
    """
    _one_of("score", score, SCORES)
    _check_place(connection, study, "tune", agent)
    known = _column(
        connection,
        "SELECT DISTINCT environment FROM members WHERE study = ? AND stage = 'tune' AND agent = ? ORDER BY environment",
        [study, agent],
    )
    for name in environments or ():
        _one_of(f"{agent} in study {study}: environment", name, known)
    chosen = tuple(name for name in known if environments is None or name in environments)
    scale, name, frozen = find_normalizer(connection, study, score, normalizer, chosen)
    found = _settings(connection, study, "tune", agent, chosen)
    candidates = _joined(found)
    if not candidates:
        raise UserError(f'study "{study}": no setting of {agent} is on all of {", ".join(chosen)}; name fewer environments')
    hashes = [tuple(found[place].hashes[rows[place]] for place in chosen) for rows, _ in candidates]
    order = sorted(range(len(candidates)), key=lambda h: (sorted(hashes[h]), str(candidates[h][1])))
    seeds, raw = _values(connection, study, "tune", agent, score, {place: found[place].hashes for place in chosen})
    values = np.stack(
        [normalize(scale, place, raw[place])[[candidates[h][0][place] for h in order]] for place in chosen],
    )
    if not np.isfinite(values).any():
        raise UserError(f'study "{study}": {agent} has no {score} of a tune run yet')
    names = list(dict.fromkeys(name for here in found.values() for name in here.hypers))
    used = {(place, row) for rows, _ in candidates for place, row in rows.items()}
    return AcrossScores(
        agent=agent,
        environments=chosen,
        score=score,
        normalizer=name,
        frozen=frozen,
        seeds=seeds,
        settings=tuple(hashes[h] for h in order),
        hypers=_varying({name: [candidates[h][1].get(name) for h in order] for name in names}),
        values=values,
        num_left_out=sum(len(here.hashes) for here in found.values()) - len(used),
    )


def load_evaluated(
    connection: duckdb.DuckDBPyConnection,
    study: str,
    agent: str,
    *,
    score: str = "episode_mean",
    normalizer: str | None = None,
    environments: Sequence[str] | None = None,
) -> EvaluatedScores:
    """Return the normalized evaluation scores of the settings that the study's selection chose for an agent, by both rules.

    `environments`: only these; default: all for which there is a choice.

    Raises UserError as `load`, where nothing is chosen by one of the rules or a choice is made for each value of a
    hyperparameter, and where the normalizer is undefined.
    """
    _one_of("score", score, SCORES)
    _check_place(connection, study, "evaluate", agent)
    rows = connection.execute(
        'SELECT environment, "by", setting, for_each FROM selections WHERE study = ? AND agent = ? ORDER BY ALL', [study, agent]
    ).fetchall()
    if any(json.loads(for_each) for *_, for_each in rows):
        raise UserError(
            f'study "{study}": settings of {agent} are chosen for each value of a hyperparameter, not one an environment'
        )
    chosen = {(by, environment): setting for environment, by, setting, _ in rows}
    places = tuple(sorted({environment for by, environment in chosen if (ACROSS_ENVIRONMENTS, environment) in chosen}))
    places = places if environments is None else tuple(place for place in places if place in environments)
    lacking = [place for place in places if (PER_ENVIRONMENT, place) not in chosen]
    if lacking or not places:
        raise UserError(f'study "{study}": {agent} needs a choice per environment and one across environments')
    scale, name, _ = find_normalizer(connection, study, score, normalizer, places)
    # a setting that both rules chose is there once, and is the first and the last
    both = {place: tuple(dict.fromkeys(chosen[by, place] for by in (PER_ENVIRONMENT, ACROSS_ENVIRONMENTS))) for place in places}
    seeds, raw = _values(connection, study, "evaluate", agent, score, both)
    tuned, compromise = (np.stack([normalize(scale, place, raw[place][row]) for place in places]) for row in (0, -1))
    return EvaluatedScores(agent, places, score, name, seeds, tuned, compromise)


@dataclass(frozen=True)
class _Settings:
    """Hashes [H], ascending, and name → the value of each, of the hyperparameters that apply to any of them."""

    hashes: tuple[str, ...]
    hypers: dict[str, list[Any]]


def _one_of(what: str, value: str, choices: Sequence[str]) -> None:
    if value not in choices:
        raise UserError(f'{what} "{value}" is not known; {suggestion(value, choices)}')


def _check_place(
    connection: duckdb.DuckDBPyConnection, study: str, stage: str, agent: str, environment: str | None = None
) -> None:
    _one_of("study", study, _column(connection, "SELECT DISTINCT study FROM members"))
    places = connection.execute(
        "SELECT DISTINCT agent, environment FROM members WHERE study = ? AND stage = ?", [study, stage]
    ).fetchall()
    if not places:
        raise UserError(f'study "{study}" has no {stage} trial')
    _one_of(f"study {study}: agent", agent, sorted({name for name, _ in places}))
    if environment is not None:
        _one_of(f"{agent} in study {study}: environment", environment, sorted({name for of, name in places if of == agent}))


def _column(connection: duckdb.DuckDBPyConnection, query: str, values: Sequence[Any] = ()) -> list[str]:
    return [row[0] for row in connection.execute(query, list(values)).fetchall()]


def _settings(
    connection: duckdb.DuckDBPyConnection, study: str, stage: str, agent: str, environments: Sequence[str]
) -> dict[str, _Settings]:
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
        environment: _Settings(
            tuple(row["setting"] for row in here),
            {
                name: [tuple(row[name]) if isinstance(row[name], list) else row[name] for row in here]
                for name in names
                if name not in schema.MEMBERS.names and any(row[name] is not None for row in here)
            },
        )
        for environment, here in rows.items()
    }


def _values(
    connection: duckdb.DuckDBPyConnection, study: str, stage: str, agent: str, score: str, settings: Mapping[str, Sequence[str]]
) -> tuple[tuple[int, ...], dict[str, np.ndarray]]:
    """Return the seeds, ascending, and environment → scores [H, S] of these settings, NaN where there is none."""
    rows = connection.execute(
        f"""
        SELECT environment, setting, seed, {score}
        FROM study_trials
        WHERE study = ? AND stage = ? AND agent = ? AND list_contains(?, environment)
        """,
        [study, stage, agent, list(settings)],
    ).fetchall()
    seeds = tuple(sorted({seed for _, _, seed, _ in rows}))
    column = {seed: s for s, seed in enumerate(seeds)}
    places = {(environment, setting): h for environment, here in settings.items() for h, setting in enumerate(here)}
    values = {environment: np.full((len(here), len(seeds)), np.nan) for environment, here in settings.items()}
    for environment, setting, seed, value in rows:
        if value is not None and (environment, setting) in places:
            values[environment][places[environment, setting], column[seed]] = value
    return seeds, values


def _varying(hypers: Mapping[str, Sequence[Any]]) -> dict[str, tuple[Any, ...]]:
    return {name: tuple(values) for name, values in hypers.items() if len(set(values)) > 1}


def _joined(found: Mapping[str, _Settings]) -> list[tuple[dict[str, int], dict[str, Any]]]:
    """Return the candidates on all environments: environment → the place of its setting there, and name → value."""
    candidates: list[tuple[dict[str, int], dict[str, Any]]] = [({}, {})]
    known: set[str] = set()
    for environment, here in sorted(found.items(), key=lambda item: -len(item[1].hypers)):
        shared = [name for name in here.hypers if name in known]
        matching: dict[tuple[Any, ...], list[int]] = {}
        for row in range(len(here.hashes)):
            matching.setdefault(tuple(here.hypers[name][row] for name in shared), []).append(row)
        candidates = [
            ({**rows, environment: row}, {**values, **{name: column[row] for name, column in here.hypers.items()}})
            for rows, values in candidates
            for row in matching.get(tuple(values[name] for name in shared), [])
        ]
        known.update(here.hypers)
    return candidates
