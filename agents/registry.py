"""Names of algorithms and environments → what can be known of them without torch, and where they are implemented."""

import functools
import importlib
import inspect
import os
import sys
from dataclasses import dataclass
from typing import Any

from agents.hypers import (
    ActionKind,
    ActorCriticHypers,
    DDPGHypers,
    FreeHypers,
    GreedyACHypers,
    Hypers,
    SACHypers,
    SACOriginalHypers,
    VanillaACHypers,
)


@dataclass(frozen=True)
class Algorithm:
    """An algorithm by name: its hyperparameters, the action spaces it can act in, "module:Class".

    `results_version` is part of every trial's identity: raise it when the same trial would give other numbers. A function
    that trains `one_trial` at a time is called as `train(config, seed, report)` (`agents.function`). `evaluates` says whether
    it can act deterministically.
    """

    name: str
    hypers: type[Hypers]
    actions: tuple[ActionKind, ...]
    implementation: str
    results_version: int = 1
    one_trial: bool = False
    evaluates: bool = True

    def load(self) -> Any:
        """Import and return the class that implements the algorithm (imports torch)."""
        return _load(self.implementation)


@dataclass(frozen=True)
class Environment:
    """An environment by name: its action space's kind, its default cutoff in steps, "module:Class".

    The class is made with the kind of its actions, or, where `keeps_state`, with the name and the size of the population.
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
        return cls(self.name, population) if self.keeps_state else cls(self.actions)


class AlgorithmLookupError(LookupError):
    """A name leads to no algorithm that can be trained: `reason` says why."""

    def __init__(self, name: str, reason: str) -> None:
        """Take the name and what is wrong with it."""
        super().__init__(name, reason)
        self.name, self.reason = name, reason

    def __str__(self) -> str:
        return f'"{self.name}": {self.reason}'


class EnvironmentLookupError(LookupError):
    """A name leads to no environment that can be trained on: `reason` says why.

    `choices` are Gymnasium's registered ids when the name is simply unknown, and empty otherwise.
    """

    def __init__(self, name: str, reason: str, choices: tuple[str, ...] = ()) -> None:
        """Take the name, what is wrong with it, and what it could have been."""
        super().__init__(name, reason, choices)
        self.name, self.reason, self.choices = name, reason, choices

    def __str__(self) -> str:
        return f'"{self.name}": {self.reason}'


def _load(implementation: str) -> Any:
    module, _, name = implementation.partition(":")
    return getattr(_import(module), name)


def _import(module: str) -> Any:
    here = os.getcwd()
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
    return importlib.import_module(module)


ALGORITHMS: dict[str, Algorithm] = {
    algorithm.name: algorithm
    for algorithm in (
        Algorithm("DDPG", DDPGHypers, ("continuous",), "agents.algorithms.ddpg:DDPG"),
        Algorithm("GreedyAC", GreedyACHypers, ("continuous", "discrete"), "agents.algorithms.greedy_ac:GreedyAC"),
        Algorithm("SAC", SACHypers, ("continuous", "discrete"), "agents.algorithms.sac:SAC"),
        Algorithm("SAC-original", SACOriginalHypers, ("continuous", "discrete"), "agents.algorithms.sac_original:SACOriginal"),
        Algorithm("VanillaAC", VanillaACHypers, ("continuous", "discrete"), "agents.algorithms.vanilla_ac:VanillaAC"),
    )
}

ENVIRONMENTS: dict[str, Environment] = {
    environment.name: environment
    for environment in (
        Environment("Acrobot-CA", "continuous", 1_000, "agents.environments.acrobot:Acrobot"),
        Environment("Acrobot-DA", "discrete", 1_000, "agents.environments.acrobot:Acrobot"),
        Environment("MountainCar-CA", "continuous", 1_000, "agents.environments.mountain_car:MountainCar"),
        Environment("MountainCar-DA", "discrete", 1_000, "agents.environments.mountain_car:MountainCar"),
        Environment("Pendulum-CA", "continuous", 1_000, "agents.environments.pendulum:Pendulum"),
        Environment("Pendulum-DA", "discrete", 1_000, "agents.environments.pendulum:Pendulum"),
    )
}


@functools.cache
def find_algorithm(name: str) -> Algorithm:
    """Return a built-in algorithm, or the user's own that `package.module:Name` leads to: a class or a function.

    The module is imported, from the folder of the call too. A class declares `hypers` (a `Hypers` dataclass), and may declare
    `actions` (the kinds of action spaces, default both) and `results_version` (default 1), as a function may.
    Raises AlgorithmLookupError.
    """
    if name in ALGORITHMS:
        return ALGORITHMS[name]
    module, colon, attribute = name.partition(":")
    if not colon or not module or not attribute:
        raise AlgorithmLookupError(name, "unknown agent")
    try:
        loaded = _import(module)
    except Exception as error:  # whatever the user's module does
        raise AlgorithmLookupError(name, f"cannot be imported: {type(error).__name__}: {error}") from error
    if not hasattr(loaded, attribute):
        raise AlgorithmLookupError(name, f"the module {module} has no {attribute}")
    found = getattr(loaded, attribute)
    version = getattr(found, "results_version", 1)
    if not inspect.isclass(found):
        if not callable(found):
            raise AlgorithmLookupError(name, "is neither a class nor a function")
        return Algorithm(name, FreeHypers, ("continuous", "discrete"), name, version, one_trial=True, evaluates=False)
    hypers, actions = getattr(found, "hypers", None), getattr(found, "actions", ("continuous", "discrete"))
    if not (inspect.isclass(hypers) and issubclass(hypers, ActorCriticHypers)):
        raise AlgorithmLookupError(name, "declares no hyperparameters: `hypers` must be a subclass of ActorCriticHypers")
    actions = (actions,) if isinstance(actions, str) else tuple(actions)
    if not actions or not set(actions) <= {"continuous", "discrete"}:
        raise AlgorithmLookupError(name, "`actions` must be among 'continuous' and 'discrete'")
    return Algorithm(name, hypers, actions, name, version, evaluates=hasattr(found, "act_deterministically"))


def find_environment(name: str) -> Environment:
    """Return a built-in environment, or one registered with Gymnasium: `CartPole-v1`, or `package.module:Id-v0`.

    The latter imports the module first. Gymnasium is imported only for names that are not built in, torch never; an environment
    of Gymnasium's is made once, to see its spaces.

    Raises EnvironmentLookupError when there is none of that name, when something that it needs is not installed, and when its
    observations or actions are none that agents can be trained with.
    """
    if name in ENVIRONMENTS:
        return ENVIRONMENTS[name]
    try:
        describe = _load("agents.environments.discovery:describe")
    except ModuleNotFoundError as error:
        if error.name != "gymnasium":
            raise
        reason = f"is not built in ({', '.join(ENVIRONMENTS)} are), and Gymnasium, which may know it, is not installed here"
        raise EnvironmentLookupError(name, reason) from None
    return describe(name)
