"""Pendulum swing-up with continuous torque, as the thesis' author published it (thesis section 5.1).

State (θ, ω): angle in [−π, π), 0 upright, and angular velocity in [−8, 8]; the observation is the state. Gravity 10, mass and
length 1, time step 0.05, torque in [−2, 2]. Reward cos θ'. Never terminates; starts at θ = −π, ω = 0, always.

Deviation from the thesis' text: it prints |ω| ≤ 1, with which the pendulum cannot be swung up.
"""

import math

import torch
from torch import Tensor

from agents.environment import Transition
from agents.rng import RandomStream
from agents.spaces import Continuous

_TIME_STEP, _MAX_SPEED = 0.05, 8.0


class Pendulum:
    """Batched pure functions on states [P, 2] (float64)."""

    observation_size = 2
    actions = Continuous((-2.0,), (2.0,))

    def start(self, stream: RandomStream, step: int, where: Tensor | None = None) -> Tensor:
        """Return start states [P, 2]."""
        states = torch.zeros(len(stream.seeds), 2, dtype=torch.float64, device=stream.seeds.device)
        states[:, 0] = -math.pi
        return states

    def step(self, states: Tensor, actions: Tensor) -> Transition:
        """Apply torques [P, 1]; those outside [−2, 2] are clipped. The angle moves with the velocity before it is clipped."""
        theta, omega = states.unbind(1)
        torque = actions[:, 0].double().clamp(-2, 2)
        omega = omega + (15 * torch.sin(theta) + 3 * torque) * _TIME_STEP
        theta = torch.remainder(theta + _TIME_STEP * omega + math.pi, 2 * math.pi) - math.pi
        omega = omega.clamp(-_MAX_SPEED, _MAX_SPEED)
        return Transition(torch.stack([theta, omega], dim=1), torch.cos(theta), torch.zeros_like(theta, dtype=torch.bool))

    def observe(self, states: Tensor) -> Tensor:
        """Return observations [P, 2] (float32)."""
        return states.float()
