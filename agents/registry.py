"""Names of algorithms and environments → what can be known of them without torch, and where they are implemented."""

import importlib
from dataclasses import dataclass
from typing import Any

from agents.hypers import ActionKind, GreedyACHypers, Hypers, SACHypers


@dataclass(frozen=True)
class Algorithm:
    """An algorithm by name: its hyperparameters, the action spaces it can act in, "module:Class".

    `results_version` is part of every trial's identity: raise it when the same trial would give other numbers.
    """

    name: str
    hypers: type[Hypers]
    actions: tuple[ActionKind, ...]
    implementation: str
    results_version: int = 1

    def load(self) -> Any:
        """Import and return the class that implements the algorithm (imports torch)."""
        return _load(self.implementation)


@dataclass(frozen=True)
class Environment:
    """An environment by name: its action space's kind, its default cutoff in steps, "module:Class".

    The class is made with no arguments, or, where `keeps_state`, with the name and the size of the population.
    """

    name: str
    actions: ActionKind
    cutoff: int
    implementation: str
    results_version: int = 1
    keeps_state: bool = False

    def make(self, population: int) -> Any:
        """Import and make the environment for a population (imports torch)."""
        cls = _load(self.implementation)
        return cls(self.name, population) if self.keeps_state else cls()


def _load(implementation: str) -> Any:
    module, _, name = implementation.partition(":")
    return getattr(importlib.import_module(module), name)


ALGORITHMS: dict[str, Algorithm] = {
    algorithm.name: algorithm
    for algorithm in (
        Algorithm("GreedyAC", GreedyACHypers, ("continuous",), "agents.algorithms.greedy_ac:GreedyAC"),
        Algorithm("SAC", SACHypers, ("continuous",), "agents.algorithms.sac:SAC"),
    )
}

ENVIRONMENTS: dict[str, Environment] = {
    environment.name: environment
    for environment in (
        Environment("MountainCar-CA", "continuous", 1_000, "agents.environments.mountain_car:MountainCar"),
        Environment("Pendulum-CA", "continuous", 1_000, "agents.environments.pendulum:Pendulum"),
    )
}
