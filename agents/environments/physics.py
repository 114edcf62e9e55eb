"""What the built-in environments share: one force, start states from a box, and the state as the observation.

The force is a number in ±`force_bound`: a continuous action is clipped to it; the three discrete ones are −1, 0 and 1 times it.
"""

import functools
from typing import ClassVar

import torch
from torch import Tensor

from agents.environment import Transition
from agents.hypers import ActionKind
from agents.rng import Purpose, RandomStream
from agents.spaces import ActionSpace, Continuous, Discrete


class Physics:
    """Batched pure functions on states [P, S] (float64).

    States lie between `low` and `high`; start states are uniform between `start_low` and `start_low` + `start_width`.
    """

    low: ClassVar[tuple[float, ...]]
    high: ClassVar[tuple[float, ...]]
    start_low: ClassVar[tuple[float, ...]]
    start_width: ClassVar[tuple[float, ...]]
    force_bound: ClassVar[float]

    def __init__(self, kind: ActionKind = "continuous") -> None:
        """Take continuous actions, or the three discrete ones."""
        bound = self.force_bound
        self.actions: ActionSpace = Continuous((-bound,), (bound,)) if kind == "continuous" else Discrete(3)
        self.observation_size = len(self.high)

    def start(self, stream: RandomStream, step: int, where: Tensor | None = None) -> Tensor:
        """Return start states [P, S]."""
        return self.start_at(stream.uniforms(Purpose.START_STATE, step, self.observation_size).double())

    def start_at(self, uniforms: Tensor) -> Tensor:
        """Return start states [P, S] for numbers [P, S] that are uniform on (0, 1)."""
        low, width = (_constant(x, uniforms.dtype, uniforms.device) for x in (self.start_low, self.start_width))
        return torch.addcmul(low, uniforms, width)

    def step(self, states: Tensor, actions: Tensor) -> Transition:
        """Apply actions [P, 1] in states [P, S]."""
        raise NotImplementedError

    def observe(self, states: Tensor) -> Tensor:
        """Return observations [P, S] (float32)."""
        return states.float()

    def force(self, actions: Tensor) -> Tensor:
        """Return the forces [P] (float64) of actions [P, 1]; those outside the range act as its ends."""
        force = actions[:, 0].double()
        if isinstance(self.actions, Discrete):
            return (force - 1).clamp(-1, 1) * self.force_bound
        return force.clamp(-self.force_bound, self.force_bound)


@functools.cache
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)


def wrap(angles: Tensor) -> Tensor:
    """Return angles in [−π, π)."""
    return torch.remainder(angles + torch.pi, 2 * torch.pi) - torch.pi
