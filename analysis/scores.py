"""Scores of settings as arrays, for the statistics: one agent on one environment, across environments, and on evaluation seeds.

Settings are in the order of their hashes, so that of equally good ones the first is that which a selection takes. A run that
diverged counts by the study's rule (view `run_scores`): it has the worst return of the environment, or is left out, as if it had
not been planned. Runs that are left out are NaN and `dropped`; those that are missing, failed or completed no episode are NaN.

Across environments the candidates are those of the selection: a setting on an environment where a hyperparameter does not apply
(GreedyAC's entropy scale with discrete actions) belongs to every candidate that agrees on the others.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import duckdb
import numpy as np

from analysis.score_rows import PlannedSettings, check_known, check_place, planned_settings, read_column, run_values
from analysis.tuning_scale import find_normalizer, normalize
from sweep import schema
from sweep.messages import UserError
from sweep.selection import ACROSS_ENVIRONMENTS, PER_ENVIRONMENT

SCORES = ("episode_mean", "step_mean", "final_mean")


@dataclass(frozen=True)
class SettingScores:
    """Scores `values` [H, S] of the settings of an agent on an environment, NaN where there is none.

    `dropped` [H, S]: which runs diverged and are left out. `hypers`: name → the value of each setting, of those that vary
    between settings; lists are tuples, None where one does not apply.
    """

    agent: str
    environment: str
    score: str
    stage: str
    seeds: tuple[int, ...]
    settings: tuple[str, ...]
    hypers: dict[str, tuple[Any, ...]]
    values: np.ndarray
    dropped: np.ndarray

    @property
    def complete(self) -> bool:
        """Whether every run that is not left out has a score, and one of each setting."""
        return bool(_whole(self.values, self.dropped).all())

    @property
    def means(self) -> np.ndarray:
        """The mean [H] over the runs that have a score, NaN where none has."""
        return mean_scores(self.values)

    def without_incomplete(self) -> "SettingScores":
        """Return the settings all of whose runs, but for those left out, have a score. Raises UserError where none has."""
        kept = np.flatnonzero(_whole(self.values, self.dropped))
        if not len(kept):
            raise UserError(f"{self.agent} on {self.environment}: no setting has all of its runs and their scores")
        return replace(
            self,
            settings=tuple(self.settings[h] for h in kept),
            hypers=_varying({name: [values[h] for h in kept] for name, values in self.hypers.items()}),
            values=self.values[kept],
            dropped=self.dropped[kept],
        )


@dataclass(frozen=True)
class AcrossScores:
    """Normalized scores `values` [E, H, S] of an agent's candidates, NaN where there is none.

    `dropped` [E, H, S]: which runs diverged and are left out. `settings` [H]: the hash of each candidate's setting on each of
    the environments. `hypers` as in SettingScores. `frozen`: whether the normalizer's constants are those of the study's
    selection, and not of the tuning runs as they are now. `num_left_out`: settings, over all environments, that belong to no
    candidate because another environment has none that agrees.
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
    dropped: np.ndarray
    num_left_out: int

    @property
    def complete(self) -> bool:
        """Whether every run that is not left out has a score, and one of each setting."""
        return bool(_whole(self.values, self.dropped).all())

    @property
    def means(self) -> np.ndarray:
        """The mean [E, H] over the runs that have a score, NaN where none has."""
        return mean_scores(self.values)

    def without_incomplete(self) -> "AcrossScores":
        """Return the candidates all of whose runs but for those left out, on all environments, have a score.

        Raises UserError where none has.
        """
        kept = np.flatnonzero(_whole(self.values, self.dropped).all(axis=0))
        if not len(kept):
            raise UserError(f"{self.agent}: no setting has all of its runs and their scores on {', '.join(self.environments)}")
        return replace(
            self,
            settings=tuple(self.settings[h] for h in kept),
            hypers=_varying({name: [values[h] for h in kept] for name, values in self.hypers.items()}),
            values=self.values[:, kept],
            dropped=self.dropped[:, kept],
        )


@dataclass(frozen=True)
class ChoiceScores:
    """Normalized scores `values` [E, S] on evaluation seeds of the settings that one rule chose; `dropped` as in AcrossScores."""

    environments: tuple[str, ...]
    seeds: tuple[int, ...]
    values: np.ndarray
    dropped: np.ndarray


@dataclass(frozen=True)
class EvaluatedScores:
    """Normalized scores [E, S] on evaluation seeds of the settings chosen per environment (`tuned`) and across (`compromise`).

    `num_dropped`: runs that diverged and are left out, NaN.
    """

    agent: str
    environments: tuple[str, ...]
    score: str
    normalizer: str
    seeds: tuple[int, ...]
    tuned: np.ndarray
    compromise: np.ndarray
    num_dropped: int


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
    check_known("score", score, SCORES)
    check_known("stage", stage, schema.STAGES)
    check_place(connection, study, stage, agent, environment)
    known = planned_settings(connection, study, stage, agent, [environment])[environment]
    seeds, found, left_out = run_values(connection, study, stage, agent, score, {environment: known.hashes})
    values, dropped = found[environment], left_out[environment]
    if not np.isfinite(values).any():
        raise UserError(f'study "{study}": {agent} on {environment} has no {score} of a {stage} run yet')
    return SettingScores(agent, environment, score, stage, seeds, known.hashes, _varying(known.hypers), values, dropped)


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
    check_known("score", score, SCORES)
    check_place(connection, study, "tune", agent)
    known = read_column(
        connection,
        "SELECT DISTINCT environment FROM members WHERE study = ? AND stage = 'tune' AND agent = ? ORDER BY environment",
        [study, agent],
    )
    for name in environments or ():
        check_known(f"{agent} in study {study}: environment", name, known)
    chosen = tuple(name for name in known if environments is None or name in environments)
    scale, name, frozen = find_normalizer(connection, study, score, normalizer, chosen)
    found = planned_settings(connection, study, "tune", agent, chosen)
    candidates = _joined(found)
    if not candidates:
        raise UserError(f'study "{study}": no setting of {agent} is on all of {", ".join(chosen)}; name fewer environments')
    hashes = [tuple(found[place].hashes[rows[place]] for place in chosen) for rows, _ in candidates]
    order = sorted(range(len(candidates)), key=lambda h: (sorted(hashes[h]), str(candidates[h][1])))
    seeds, raw, left_out = run_values(connection, study, "tune", agent, score, {place: found[place].hashes for place in chosen})
    rows_of = {place: [candidates[h][0][place] for h in order] for place in chosen}
    values = np.stack([normalize(scale, place, raw[place])[rows_of[place]] for place in chosen])
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
        dropped=np.stack([left_out[place][rows_of[place]] for place in chosen]),
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
    check_known("score", score, SCORES)
    chosen = _choices(connection, study, agent)
    places = tuple(sorted({environment for by, environment in chosen if (ACROSS_ENVIRONMENTS, environment) in chosen}))
    places = places if environments is None else tuple(place for place in places if place in environments)
    lacking = [place for place in places if (PER_ENVIRONMENT, place) not in chosen]
    if lacking or not places:
        raise UserError(f'study "{study}": {agent} needs a choice per environment and one across environments')
    scale, name, _ = find_normalizer(connection, study, score, normalizer, places)
    # a setting that both rules chose is there once, and is the first and the last
    both = {place: tuple(dict.fromkeys(chosen[by, place] for by in (PER_ENVIRONMENT, ACROSS_ENVIRONMENTS))) for place in places}
    seeds, raw, left_out = run_values(connection, study, "evaluate", agent, score, both)
    tuned, compromise = (np.stack([normalize(scale, place, raw[place][row]) for place in places]) for row in (0, -1))
    return EvaluatedScores(
        agent, places, score, name, seeds, tuned, compromise, sum(int(here.sum()) for here in left_out.values())
    )


def load_choice(
    connection: duckdb.DuckDBPyConnection, study: str, agent: str, by: str, *, score: str = "episode_mean", normalizer: str | None
) -> ChoiceScores:
    """Return the normalized evaluation scores of the settings that the study's selection chose for an agent by the rule `by`.

    Raises UserError as `load_evaluated`, but the other rule need not have chosen any.
    """
    check_known("score", score, SCORES)
    chosen = {environment: setting for (of, environment), setting in _choices(connection, study, agent).items() if of == by}
    if not chosen:
        raise UserError(f'study "{study}": nothing is chosen {by.replace("-", " ")} for {agent}')
    places = tuple(sorted(chosen))
    scale, _, _ = find_normalizer(connection, study, score, normalizer, places)
    seeds, raw, left_out = run_values(connection, study, "evaluate", agent, score, {place: (chosen[place],) for place in places})
    values = np.stack([normalize(scale, place, raw[place][0]) for place in places])
    return ChoiceScores(places, seeds, values, np.stack([left_out[place][0] for place in places]))


def _choices(connection: duckdb.DuckDBPyConnection, study: str, agent: str) -> dict[tuple[str, str], str]:
    """Return rule and environment → the setting that the study's selection chose for an agent."""
    check_place(connection, study, "evaluate", agent)
    rows = connection.execute(
        'SELECT environment, "by", setting, for_each FROM selections WHERE study = ? AND agent = ? ORDER BY ALL', [study, agent]
    ).fetchall()
    if any(json.loads(for_each) for *_, for_each in rows):
        raise UserError(
            f'study "{study}": settings of {agent} are chosen for each value of a hyperparameter, not one an environment'
        )
    return {(by, environment): setting for environment, by, setting, _ in rows}


def mean_scores(values: np.ndarray) -> np.ndarray:
    """Return the mean [...] of values [..., S] over those that there are, NaN where there is none."""
    finite = np.isfinite(values)
    counts = finite.sum(axis=-1)
    sums = np.where(finite, values, 0.0).sum(axis=-1)
    return np.divide(sums, counts, out=np.full(counts.shape, np.nan), where=counts > 0)


def _whole(values: np.ndarray, dropped: np.ndarray) -> np.ndarray:
    """Return which settings [...] have a score of each run [..., S] that is not left out, and of one at least."""
    finite = np.isfinite(values)
    return np.asarray((finite | dropped).all(axis=-1) & finite.any(axis=-1))


def _varying(hypers: Mapping[str, Sequence[Any]]) -> dict[str, tuple[Any, ...]]:
    return {name: tuple(values) for name, values in hypers.items() if len(set(values)) > 1}


def _joined(found: Mapping[str, PlannedSettings]) -> list[tuple[dict[str, int], dict[str, Any]]]:
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
