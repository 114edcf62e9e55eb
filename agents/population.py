"""The agents that are trained together: their hyperparameters, their seeds, and where they live."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from agents.hypers import Hypers
from agents.rng import RandomStream


@dataclass(frozen=True)
class Population:
    """P agents of one algorithm, with equal shared hyperparameters; `seeds` are the keys of their random streams."""

    hypers: tuple[Hypers, ...]
    seeds: tuple[int, ...]
    device: torch.device

    def __post_init__(self) -> None:
        if len(self.hypers) != len(self.seeds) or not self.hypers:
            raise ValueError(f"{len(self.hypers)} hyperparameter settings for {len(self.seeds)} seeds")
        if len({(type(hypers), hypers.shared()) for hypers in self.hypers}) > 1:
            raise ValueError("agents that are trained together must have equal shared hyperparameters")

    def __len__(self) -> int:
        return len(self.hypers)

    @property
    def shared(self) -> Any:
        """The hyperparameters of any one agent, to read those that all of them share."""
        return self.hypers[0]

    def stacked(self, name: str) -> Tensor:
        """Return a hyperparameter (or a property derived from them) of every agent: float32 [P]."""
        return torch.tensor([getattr(hypers, name) for hypers in self.hypers], dtype=torch.float32, device=self.device)

    def stream(self) -> RandomStream:
        """Return the agents' random streams."""
        return RandomStream(torch.tensor(self.seeds, dtype=torch.int64, device=self.device))


def padded(hypers: Sequence[Hypers], seeds: Sequence[int], device: torch.device) -> Population:
    """Return a population of at least two: a single agent gets a copy beside it, so that it computes as in a crowd."""
    copies = 2 if len(hypers) == 1 else 1
    return Population(tuple(hypers) * copies, tuple(seeds) * copies, device)
