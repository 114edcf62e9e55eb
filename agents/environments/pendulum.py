"""Pendulum swing-up, as the thesis' author published it (thesis section 5.1).

State (θ, ω): angle in [−π, π), 0 upright, and angular velocity in [−8, 8]; the observation is the state. Gravity 10, mass and
length 1, time step 0.05. Torque in [−2, 2], or −2, 0, 2 with discrete actions. Reward cos θ'. Never terminates; starts at
θ = −π, ω = 0, always.

Deviation from the thesis' text: it prints |ω| ≤ 1, with which the pendulum cannot be swung up.
"""

import math

import torch
from torch import Tensor

from agents.environment import Transition
from agents.environments.physics import Physics, wrap

_TIME_STEP, _MAX_SPEED = 0.05, 8.0


class Pendulum(Physics):
    """Batched pure functions on states [P, 2] (float64)."""

    low, high = (-math.pi, -_MAX_SPEED), (math.pi, _MAX_SPEED)
    start_low, start_width = (-math.pi, 0.0), (0.0, 0.0)
    force_bound = 2.0

    def step(self, states: Tensor, actions: Tensor) -> Transition:
        """Apply actions [P, 1]. The angle moves with the velocity before it is clipped."""
        theta, omega = states.unbind(1)
        omega = omega + (15 * torch.sin(theta) + 3 * self.force(actions)) * _TIME_STEP
        theta = wrap(theta + _TIME_STEP * omega)
        omega = omega.clamp(-_MAX_SPEED, _MAX_SPEED)
        return Transition(torch.stack([theta, omega], dim=1), torch.cos(theta), torch.zeros_like(theta, dtype=torch.bool))
