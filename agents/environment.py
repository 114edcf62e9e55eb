"""What an environment is to the training loop: P copies of it, one for each agent, that step together.

The built-in ones are pure functions on the states of a population; one that keeps its own state (Gymnasium's) hands out
observations as states.
"""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from agents.rng import RandomStream
from agents.spaces import ActionSpace


@dataclass(frozen=True)
class Transition:
    """One step of every agent: next states [P, …], rewards [P] (float64), terminated [P] (bool).

    The cutoff is the training loop's; an environment that truncates by a rule of its own says so in `truncated` [P] (bool).
    """

    states: Tensor
    rewards: Tensor
    terminated: Tensor
    truncated: Tensor | None = None


class Environment(Protocol):
    """P independent copies of an environment. `observation_size` is S, `actions` the action space."""

    observation_size: int
    actions: ActionSpace

    def start(self, stream: RandomStream, step: int, where: Tensor | None = None) -> Tensor:
        """Return start states [P, …] drawn at this step; with `where` [P] (bool), only those rows are looked at."""
        ...

    def step(self, states: Tensor, actions: Tensor) -> Transition:
        """Apply actions [P, A] in states [P, …]."""
        ...

    def observe(self, states: Tensor) -> Tensor:
        """Return observations [P, S] (float32)."""
        ...
