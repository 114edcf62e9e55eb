"""What an environment is to the training loop: batched pure functions on the states of a population."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from agents.policies import Continuous
from agents.rng import RandomStream


@dataclass(frozen=True)
class Transition:
    """One step of every agent: next states [P, …], rewards [P] (float64), terminated [P] (bool); a cutoff is the loop's."""

    states: Tensor
    rewards: Tensor
    terminated: Tensor


class Environment(Protocol):
    """P independent copies of an environment. `observation_size` is S, `actions` the action space."""

    observation_size: int
    actions: Continuous

    def start(self, stream: RandomStream, step: int) -> Tensor:
        """Return a start state for every agent, drawn at this step."""
        ...

    def step(self, states: Tensor, actions: Tensor) -> Transition:
        """Apply actions [P, A] in states [P, …]."""
        ...

    def observe(self, states: Tensor) -> Tensor:
        """Return observations [P, S] (float32)."""
        ...
