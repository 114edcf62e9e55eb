"""What an algorithm is to the training loop."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from agents.population import Population
from agents.replay import Batch
from agents.rng import RandomStream
from agents.spaces import ActionSpace


@dataclass(frozen=True)
class Task:
    """What an algorithm is told of the environment: the size S of an observation, the actions, and the discount γ."""

    observation_size: int
    actions: ActionSpace
    discount: float


class Algorithm(Protocol):
    """P agents that act and learn in lock-step. Every number must depend on one agent only.

    A class may declare `capturable = True`: its `act` and `update` are the same tensor operations at every step from the first
    update on, use `step` for drawing random numbers only, never read a tensor's value in Python, change in place what lasts, and
    do not need autograd. But in an environment of Gymnasium's, they are then recorded once, as a CUDA graph, on a GPU, and run
    in PyTorch's inference mode on a CPU.
    """

    def __init__(self, population: Population, task: Task, stream: RandomStream) -> None: ...

    def act(self, observations: Tensor, step: int) -> Tensor:
        """Return the actions [P, A] for observations [P, S] at this step; captured steps overwrite the observations later."""
        ...

    def act_deterministically(self, observations: Tensor) -> Tensor:
        """Return actions [P, A] without exploration, drawing no random numbers; needed for evaluation episodes only."""
        ...

    def update(self, batch: Batch, step: int) -> Tensor:
        """Learn from a batch and return the critic's loss [P]; an agent whose loss is not finite has diverged."""
        ...
