"""Mountain Car with continuous actions (Moore, 1990), as the thesis' author published it (thesis section 5.1).

State (x, v): position in [−1.2, 0.6], velocity in [−0.07, 0.07]; the observation is the state. Force 0.0015, and the goal is
x ≥ 0.45 with v ≥ 0. Reward −1 on every step, the last one included. Starts at x ~ U[−0.6, −0.4], v = 0.
"""

import torch
from torch import Tensor

from agents.environment import Transition
from agents.rng import Purpose, RandomStream
from agents.spaces import Continuous

_FORCE, _GRAVITY, _GOAL = 0.0015, 0.0025, 0.45


class MountainCar:
    """Batched pure functions on states [P, 2] (float64)."""

    observation_size = 2
    actions = Continuous((-1.0,), (1.0,))

    def start(self, stream: RandomStream, step: int, where: Tensor | None = None) -> Tensor:
        """Return start states [P, 2]."""
        x = stream.uniforms(Purpose.START_STATE, step, 1).double() * 0.2 - 0.6
        return torch.cat([x, torch.zeros_like(x)], dim=1)

    def step(self, states: Tensor, actions: Tensor) -> Transition:
        """Apply actions [P, 1]; those outside [−1, 1] are clipped."""
        x, v = states.unbind(1)
        force = actions[:, 0].double().clamp(-1, 1)
        v = (v + _FORCE * force - _GRAVITY * torch.cos(3 * x)).clamp(-0.07, 0.07)
        x = (x + v).clamp(-1.2, 0.6)
        v = torch.where((x <= -1.2) & (v < 0), 0.0, v)
        terminated = (x >= _GOAL) & (v >= 0)
        return Transition(torch.stack([x, v], dim=1), torch.full_like(x, -1.0), terminated)

    def observe(self, states: Tensor) -> Tensor:
        """Return observations [P, 2] (float32)."""
        return states.float()
