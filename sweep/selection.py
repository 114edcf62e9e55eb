"""Selection: which settings the evaluation stage evaluates, chosen from the scores of the tuning stage.

A run's score is one of the columns of `trials` (`[select] score`). A *candidate* is a setting of the grid before anything is
dropped; on an environment it is what remains of it there, and candidates of which the same remains are one setting there.

    per-environment      the setting with the highest mean over seeds of the score
    across-environments  the candidate with the highest mean over its environments of the mean over seeds of the normalized score

Both are chosen for each agent, and with `for_each` for each combination of those hyperparameters' values. Of equally good
settings the lowest hash is chosen; across environments, the lowest sorted hashes of the candidate's settings. Means
are exactly rounded sums divided by counts: the order in which files are read changes no choice. A diverged run scores the
worst return of the environment (`worst`), or is left out of the mean (`drop`).
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from agents.hypers import Hypers
from agents.registry import find_environment
from sweep.grid import Grid
from sweep.normalizers import Normalizer, UndefinedNormalizerError
from sweep.trials import Candidate, candidates, expand, trial_of
from sweep.tuning import IncompleteError, Measured, Place, TrialScores, measure, normalizer, refuse_missing

__all__ = ["Choice", "IncompleteError", "Selection", "TrialScores", "select"]

PER_ENVIRONMENT, ACROSS_ENVIRONMENTS = "per-environment", "across-environments"
_EDGE_VALUES = 3  # with two values, every choice is on an edge


@dataclass(frozen=True)
class Choice:
    """The setting that was chosen for an agent on an environment, by one of the two rules.

    `for_each`: the values of those hyperparameters that it was chosen for. `mean`: its mean score on this environment.
    `normalized`: its mean normalized score, across environments that over all of them, which is what was maximized; None
    where the normalizer is undefined and was not needed. `num_seeds`: the runs behind `mean`. `num_settings` were compared;
    `num_left_out` were not, because a run is missing or has no score. `runner_up` is the second best, None where there was
    no other; `num_tied` others were exactly as good. `on_edge` names the swept hyperparameters whose value here is the
    lowest or the highest of at least three that were swept.
    """

    by: str
    agent: str
    environment: str
    for_each: dict[str, Any]
    hypers: Hypers
    setting: str
    score: str
    normalizer: str
    diverged: str
    mean: float
    normalized: float | None
    num_seeds: int
    num_settings: int
    num_left_out: int
    runner_up: str | None
    runner_up_mean: float | None
    runner_up_normalized: float | None
    num_tied: int
    on_edge: tuple[str, ...]


@dataclass(frozen=True)
class Selection:
    """The choices, by rule, agent and environment; the normalizer they were made with; and what could not be chosen, and why."""

    choices: list[Choice]
    normalizer: Normalizer
    messages: list[str]

    def __iter__(self) -> Iterator[Choice]:
        return iter(self.choices)

    def __len__(self) -> int:
        return len(self.choices)


@dataclass(frozen=True)
class _Entrant:
    """What is compared: a candidate with its settings by environment. Of two equally good ones the lower `key` wins."""

    hypers: Hypers
    settings: dict[str, str]

    @property
    def key(self) -> tuple[str, ...]:
        return tuple(sorted(self.settings.values()))


def select(
    grid: Grid, scores: Mapping[str, TrialScores], worst_returns: Mapping[str, float], *, allow_partial: bool = False
) -> Selection:
    """Return what is chosen from the scores of the tuning trials (by trial; one that is absent is missing).

    `worst_returns`: the lowest return of a completed episode by environment, for diverged runs. With `allow_partial` settings
    that lack a run are left out.

    Raises IncompleteError when a tuning trial is missing, UserError where a score across environments is undefined.
    """
    trials = expand(grid)
    if not allow_partial:
        refuse_missing(grid, trials, scores)
    measured = measure(grid, trials, scores, worst_returns)
    chosen = _Chosen(grid, measured, normalizer(grid, trials, scores, measured))
    entrants = _entrants(grid)
    for by in grid.select.by:
        for agent, environments in _agents(grid):
            if by == PER_ENVIRONMENT:
                for environment in environments:
                    chosen.add(by, agent, (environment,), _distinct(entrants[agent], environment))
            else:
                for together in _largest(entrant.settings for entrant in entrants[agent]):
                    chosen.add(by, agent, together, [e for e in entrants[agent] if set(together) == set(e.settings)])
    return Selection(chosen.choices, chosen.normalizer, chosen.messages)


def _agents(grid: Grid) -> list[tuple[str, list[str]]]:
    """Return each agent once, with the environments of all its sections in the study's order."""
    environments: dict[str, set[str]] = {}
    for agent in grid.agents:
        environments.setdefault(agent.name, set()).update(agent.environments)
    return [(agent, [name for name in grid.environments if name in here]) for agent, here in environments.items()]


def _entrants(grid: Grid) -> dict[str, list[_Entrant]]:
    """Return the candidates by agent, in an order that depends on them alone.

    A candidate that several sections of an agent have is one, on the environments of all of them; and of candidates that are
    the same setting on all of their environments there is one.
    """
    merged: dict[tuple[str, str], tuple[Hypers, set[str]]] = {}
    for candidate in candidates(grid):
        # by text, because the values 1, 1.0 and true of a function's hyperparameters are equal and are three settings
        _, here = merged.setdefault((candidate.agent, _text(candidate.hypers)), (candidate.hypers, set()))
        here.update(candidate.environments)
    entrants: dict[str, list[_Entrant]] = {agent.name: [] for agent in grid.agents}
    for (agent, _), (hypers, here) in merged.items():
        known = Candidate(agent, hypers, tuple(name for name in grid.environments if name in here))
        entrants[agent].append(_Entrant(hypers, settings_of(grid, known)))
    return {agent: _first_of_equals(listed) for agent, listed in entrants.items()}


def _first_of_equals(entrants: Iterable[_Entrant]) -> list[_Entrant]:
    ordered = sorted(entrants, key=lambda entrant: (entrant.key, _text(entrant.hypers)))
    first: dict[tuple[tuple[str, str], ...], _Entrant] = {}
    for entrant in ordered:
        first.setdefault(tuple(entrant.settings.items()), entrant)
    return list(first.values())


def _text(hypers: Hypers) -> str:
    return json.dumps(hypers.as_dict(), sort_keys=True)


def settings_of(grid: Grid, candidate: Candidate) -> dict[str, str]:
    """Return environment → what remains of a candidate there, as the hash of the setting."""
    seed = grid.tune_seeds[0]
    return {
        environment: trial_of(grid, candidate.agent, environment, candidate.hypers, seed).setting
        for environment in candidate.environments
    }


def _distinct(entrants: Iterable[_Entrant], environment: str) -> list[_Entrant]:
    """Return the settings on one environment, each once, with the hyperparameters of the first candidate that has it."""
    distinct: dict[str, _Entrant] = {}
    for entrant in entrants:
        if environment in entrant.settings:
            setting = entrant.settings[environment]
            distinct.setdefault(setting, _Entrant(entrant.hypers, {environment: setting}))
    return list(distinct.values())


def _largest(settings: Iterable[Mapping[str, str]]) -> list[tuple[str, ...]]:
    """Return the sets of environments that candidates have, without those that lie within another."""
    found = dict.fromkeys(tuple(known) for known in settings if known)
    return [here for here in found if not any(set(here) < set(other) for other in found)]


@dataclass
class _Chosen:
    """Collects choices, a comparison at a time."""

    grid: Grid
    measured: Mapping[Place, Measured]
    normalizer: Normalizer

    def __post_init__(self) -> None:
        self.choices: list[Choice] = []
        self.messages: list[str] = []
        self._normalized: dict[Place, float] = {}

    def add(self, by: str, agent: str, environments: Sequence[str], entrants: Sequence[_Entrant]) -> None:
        """Compare entrants on the environments, separately for each combination of the `for_each` hyperparameters' values."""
        groups: dict[str, tuple[dict[str, Any], list[_Entrant]]] = {}
        for entrant in entrants:
            values = self._for_each(entrant.hypers, environments)
            groups.setdefault(json.dumps(values), (values, []))[1].append(entrant)
        for values, group in sorted(groups.values(), key=lambda known: [(str(type(v)), v) for v in known[0].values()]):
            self._compare(by, agent, environments, values, group)

    def _for_each(self, hypers: Hypers, environments: Sequence[str]) -> dict[str, Any]:
        used: dict[str, Any] = {}
        for environment in environments:
            used |= hypers.applicable(find_environment(environment).actions)
        return {name: used[name] for name in self.grid.select.for_each if name in used}

    def _compare(self, by: str, agent: str, environments: Sequence[str], for_each: dict[str, Any], group: list[_Entrant]) -> None:
        compared = [entrant for entrant in group if all((agent, *place) in self.measured for place in entrant.settings.items())]
        if not compared:
            where = f"{agent} on {', '.join(environments)}" + "".join(f", {name} = {value}" for name, value in for_each.items())
            self.messages.append(f"{where}: nothing is chosen {by}: no setting has all its runs and their scores")
            return
        values = {entrant.key: self._value(by, agent, entrant) for entrant in compared}
        ranked = sorted(compared, key=lambda entrant: (-values[entrant.key], entrant.key))
        best, second = ranked[0], ranked[1] if len(ranked) > 1 else None
        for environment in environments:
            here = self.measured[agent, environment, best.settings[environment]]
            there = self.measured[agent, environment, second.settings[environment]] if second else None
            normalized, runner_up_normalized = (
                self._shown(by, agent, environment, entrant, values) if entrant else None for entrant in (best, second)
            )
            self.choices.append(
                Choice(
                    by=by,
                    agent=agent,
                    environment=environment,
                    for_each=for_each,
                    hypers=best.hypers,
                    setting=best.settings[environment],
                    score=self.grid.select.score,
                    normalizer=self.grid.select.normalizer,
                    diverged=self.grid.select.diverged,
                    mean=here.mean,
                    normalized=normalized,
                    num_seeds=len(here.scores),
                    num_settings=len(compared),
                    num_left_out=len(group) - len(compared),
                    runner_up=second.settings[environment] if second else None,
                    runner_up_mean=there.mean if there else None,
                    runner_up_normalized=runner_up_normalized,
                    num_tied=sum(values[entrant.key] == values[best.key] for entrant in compared) - 1,
                    on_edge=self._on_edge(agent, environment, best, group),
                )
            )

    def _value(self, by: str, agent: str, entrant: _Entrant) -> float:
        """Return what is maximized."""
        places = [(agent, environment, setting) for environment, setting in entrant.settings.items()]
        if by == PER_ENVIRONMENT:
            return self.measured[places[0]].mean
        return math.fsum(map(self._normalize, places)) / len(places)

    def _shown(self, by: str, agent: str, environment: str, entrant: _Entrant, values: dict[Any, float]) -> float | None:
        if by == ACROSS_ENVIRONMENTS:
            return values[entrant.key]
        try:
            return self._normalize((agent, environment, entrant.settings[environment]))
        except UndefinedNormalizerError:
            return None  # nothing was chosen by it

    def _normalize(self, place: Place) -> float:
        if place not in self._normalized:
            scores = self.normalizer.normalize(place[1], self.measured[place].scores)
            self._normalized[place] = math.fsum(scores) / len(scores)
        return self._normalized[place]

    def _on_edge(self, agent: str, environment: str, best: _Entrant, group: Iterable[_Entrant]) -> tuple[str, ...]:
        swept = {
            name: None
            for section in self.grid.agents
            if section.name == agent
            for name, v in section.values.items()
            if len(v) > 1
        }
        actions = find_environment(environment).actions
        chosen = best.hypers.applicable(actions)
        others = [entrant.hypers.applicable(actions) for entrant in group]
        edges = []
        for name in swept:
            values = {other[name] for other in others if name in other}
            numeric = all(type(value) in (int, float) for value in values)
            if name in chosen and numeric and len(values) >= _EDGE_VALUES and chosen[name] in (min(values), max(values)):
                edges.append(name)
        return tuple(edges)
