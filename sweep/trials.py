"""Trials: a setting with a seed, on an environment. A trial's name is a hash of what determines its numbers.

The hash is of the canonical JSON (keys sorted, floats by `repr`) of the configuration as resolved, defaults included: the
order of keys, 1e-3 or 0.001, and the place in a grid make no difference. The first 16 hexadecimal digits of SHA-256.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from agents.hypers import Hypers
from agents.registry import find_algorithm, find_environment
from sweep.grid import Grid

_IDENTITY_SCHEMA = 1


@dataclass(frozen=True)
class Trial:
    """One training run. `evaluation` asks for deterministic episodes: after how many steps each time, how many episodes."""

    agent: str
    environment: str
    hypers: Hypers
    seed: int
    steps: int
    cutoff: int
    discount: float
    evaluation: tuple[int, int] | None = None

    @cached_property
    def applicable_hypers(self) -> dict[str, Any]:
        """Name → value of the hyperparameters that the agent uses on the environment."""
        return self.hypers.applicable(find_environment(self.environment).actions)

    @cached_property
    def setting(self) -> str:
        """16 hexadecimal digits for the agent and its hyperparameters: the same on all environments where the same ones apply."""
        return _digest(_canonical(self._setting_identity))

    @cached_property
    def id(self) -> str:
        """16 hexadecimal digits for everything that determines the trial's numbers."""
        before, after = self._around_seed
        return _digest(f"{before}{self.seed}{after}")

    @property
    def _around_seed(self) -> tuple[str, str]:
        """What stands before and after the seed in the canonical form of everything that determines the trial's numbers."""
        identity = {
            **self._setting_identity,
            "environment": self.environment,
            "environment_version": find_environment(self.environment).results_version,
            "seed": 0,
            "steps": self.steps,
            "cutoff": self.cutoff,
            "discount": self.discount,
            **({"evaluation": list(self.evaluation)} if self.evaluation else {}),
        }
        before, key, after = _canonical(identity).rpartition('"seed":0')
        return before + key[:-1], after

    @property
    def _setting_identity(self) -> dict[str, Any]:
        return {
            "schema": _IDENTITY_SCHEMA,
            "agent": self.agent,
            "agent_version": find_algorithm(self.agent).results_version,
            "hypers": self.hypers.identity(find_environment(self.environment).actions),
        }


@dataclass(frozen=True)
class Candidate:
    """A setting among which a study selects: all of its hyperparameters, and the environments where it is tuned."""

    agent: str
    hypers: Hypers
    environments: tuple[str, ...]


def _canonical(identity: dict[str, Any]) -> str:
    return json.dumps(identity, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _digest(canonical: str) -> str:
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def trial_of(grid: Grid, agent: str, environment: str, hypers: Hypers, seed: int) -> Trial:
    """Return the trial of a study that trains a setting on one of its environments with a seed."""
    conditions = grid.conditions(environment)
    return Trial(agent, environment, hypers, seed, conditions.steps, conditions.cutoff, conditions.discount, grid.evaluation)


def expand(grid: Grid) -> list[Trial]:
    """Return the trials of a study's tuning stage, each once: by agent, environment, setting, seed."""
    settings = (
        (agent.name, environment, hypers)
        for agent in grid.agents
        for environment in agent.environments
        for hypers in agent.settings
    )
    return list(_trials(grid, settings, grid.tune_seeds))


def evaluation_trials(grid: Grid, chosen: Iterable[tuple[str, str, Hypers]]) -> list[Trial]:
    """Return the trials of the evaluation stage, each once, for what was chosen: agent, environment, hyperparameters."""
    return list(_trials(grid, chosen, grid.evaluate_seeds))


def most_evaluation_trials(grid: Grid) -> list[Trial]:
    """Return stand-ins for the trials of the evaluation stage, as many as there can be, before anything is chosen.

    For each agent, environment and value of the `for_each` hyperparameters they have the first settings, as many as [select]
    has ways to choose by.
    """
    stand_ins: list[tuple[str, str, Hypers]] = []
    taken: set[str] = set()
    places: dict[tuple[Any, ...], int] = {}
    for candidate in candidates(grid):
        values = candidate.hypers.as_dict()
        group = (candidate.agent, *(values.get(name) for name in grid.select.for_each))
        for environment in candidate.environments:
            setting = trial_of(grid, candidate.agent, environment, candidate.hypers, 0).id
            if setting not in taken and places.setdefault((environment, *group), len(grid.select.by)):
                places[environment, *group] -= 1
                taken.add(setting)
                stand_ins.append((candidate.agent, environment, candidate.hypers))
    return evaluation_trials(grid, stand_ins)


def candidates(grid: Grid) -> list[Candidate]:
    """Return every setting of every agent, before anything is dropped that does not apply.

    Those that are equal on all of their environments are one.
    """
    found: dict[tuple[Any, ...], Candidate] = {}
    for agent in grid.agents:
        kinds = sorted({find_environment(environment).actions for environment in agent.environments})
        for hypers in agent.settings:
            identity = tuple(tuple(hypers.identity(kind).items()) for kind in kinds)
            found.setdefault((agent.name, agent.environments, identity), Candidate(agent.name, hypers, agent.environments))
    return list(found.values())


def _trials(grid: Grid, settings: Iterable[tuple[str, str, Hypers]], seeds: Iterable[int]) -> Iterator[Trial]:
    """Yield trials, each once. What does not depend on the seed is worked out once a setting and environment."""
    seen: set[bytes] = set()
    seeds = list(seeds)
    for agent, environment, hypers in settings:
        first = trial_of(grid, agent, environment, hypers, 0)
        before, after = first._around_seed
        if (same := hashlib.sha256(before.encode()).digest()) in seen:
            continue
        seen.add(same)
        shared = {"setting": first.setting, "applicable_hypers": first.applicable_hypers}
        for seed in seeds:
            trial = trial_of(grid, agent, environment, hypers, seed)
            # where cached properties keep their values
            vars(trial).update(shared, id=_digest(f"{before}{seed}{after}"))
            yield trial
