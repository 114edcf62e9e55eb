"""Mountain Car (Moore, 1990), as the thesis' author published it (thesis section 5.1).

State (x, v): position in [−1.2, 0.6], velocity in [−0.07, 0.07]; the observation is the state. Reward −1 on every step, the last
one included. Starts at x ~ U[−0.6, −0.4], v = 0. Continuous actions: force 0.0015, and the goal is x ≥ 0.45 with v ≥ 0. Discrete
actions (left, nothing, right): force 0.001, and the goal is x ≥ 0.5 with v ≥ 0.
"""

import torch
from torch import Tensor

from agents.environment import Transition
from agents.environments.physics import Physics
from agents.hypers import ActionKind

_GRAVITY = 0.0025


class MountainCar(Physics):
    """Batched pure functions on states [P, 2] (float64)."""

    low, high = (-1.2, -0.07), (0.6, 0.07)
    start_low, start_width = (-0.6, 0.0), (0.2, 0.0)
    force_bound = 1.0

    def __init__(self, kind: ActionKind = "continuous") -> None:
        """Take continuous actions, or the three discrete ones; the power and the goal differ."""
        super().__init__(kind)
        self.power, self.goal = (0.0015, 0.45) if kind == "continuous" else (0.001, 0.5)

    def step(self, states: Tensor, actions: Tensor) -> Transition:
        """Apply actions [P, 1]; the position moves with the new velocity."""
        x, v = states.unbind(1)
        v = (v + self.power * self.force(actions) - _GRAVITY * torch.cos(3 * x)).clamp(-0.07, 0.07)
        x = (x + v).clamp(-1.2, 0.6)
        v = torch.where((x <= -1.2) & (v < 0), 0.0, v)
        terminated = (x >= self.goal) & (v >= 0)
        return Transition(torch.stack([x, v], dim=1), torch.full_like(x, -1.0), terminated)
