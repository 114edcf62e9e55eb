"""Trials: a setting with a seed, on an environment. A trial's name is a hash of what determines its numbers.

The hash is of the canonical JSON (keys sorted, floats by `repr`) of the configuration as resolved, defaults included: the
order of keys, 1e-3 or 0.001, and the place in a grid make no difference. The first 16 hexadecimal digits of SHA-256.
"""

import hashlib
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from agents.hypers import HyperparameterError, Hypers
from agents.registry import find_algorithm, find_environment
from sweep.grid import AgentGrid, Grid
from sweep.grid_checks import MAX_TRIALS
from sweep.messages import UserError

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
        return _digest(self._setting_identity)

    @cached_property
    def id(self) -> str:
        """16 hexadecimal digits for everything that determines the trial's numbers."""
        return _digest(
            {
                **self._setting_identity,
                "environment": self.environment,
                "environment_version": find_environment(self.environment).results_version,
                "seed": self.seed,
                "steps": self.steps,
                "cutoff": self.cutoff,
                "discount": self.discount,
                **({"evaluation": list(self.evaluation)} if self.evaluation else {}),
            }
        )

    @property
    def _setting_identity(self) -> dict[str, Any]:
        return {
            "schema": _IDENTITY_SCHEMA,
            "agent": self.agent,
            "agent_version": find_algorithm(self.agent).results_version,
            "hypers": self.hypers.identity(find_environment(self.environment).actions),
        }


def _digest(identity: dict[str, Any]) -> str:
    canonical = json.dumps(identity, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def expand(grid: Grid) -> list[Trial]:
    """Return the trials of a study's tuning stage, each once: by agent, environment, setting, seed.

    Raises UserError when the grid is larger than MAX_TRIALS or when hyperparameters contradict one another.
    """
    planned = sum(
        len(agent.environments) * math.prod(map(len, agent.values.values())) * len(grid.tune_seeds) for agent in grid.agents
    )
    if planned > MAX_TRIALS:
        raise UserError(f"{grid.name}: {planned:,} trials; at most {MAX_TRIALS:,} are planned at once")
    trials: dict[str, Trial] = {}
    contradictions: dict[str, None] = {}
    for agent in grid.agents:
        settings = list(_settings(agent, contradictions))
        for environment in agent.environments:
            for hypers in settings:
                for seed in grid.tune_seeds:
                    cutoff = grid.cutoff or find_environment(environment).cutoff
                    trial = Trial(agent.name, environment, hypers, seed, grid.steps, cutoff, grid.discount, grid.evaluation)
                    trials.setdefault(trial.id, trial)
    if contradictions:
        raise UserError("\n".join(f"{grid.name}: {message}" for message in contradictions))
    return list(trials.values())


def _settings(agent: AgentGrid, contradictions: dict[str, None]) -> Iterator[Hypers]:
    for values in itertools.product(*agent.values.values()):
        try:
            yield find_algorithm(agent.name).hypers(**dict(zip(agent.values, values, strict=True)))
        except HyperparameterError as error:
            contradictions[f"{agent.name}: {error}"] = None
