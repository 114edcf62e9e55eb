"""Acrobot (Sutton, 1996), the equations of the book (Sutton and Barto, 2018), as in the thesis (section 5.1).

State (θ1, θ2, ω1, ω2): the first link's angle, 0 hanging; the second's relative to it; both in [−π, π), |ω1| ≤ 4π, |ω2| ≤ 9π. The
observation is the state. Lengths, masses and inertias 1, centers of mass at 0.5, gravity 9.8; a step is one Runge–Kutta step of
0.2 with the torque, in [−1, 1] or −1, 0, 1, held on the joint between the links. Terminates when the tip is higher than 1
above the first joint. Reward −1 on every step, the last one included. Starts at U[−0.1, 0.1] in each of the four.

Deviations from the author's code: it starts at exactly 0, and rewards the terminating step with 0; this is the thesis' text.
"""

import math

import torch
from torch import Tensor

from agents.environment import Transition
from agents.environments.physics import Physics, wrap

_TIME_STEP, _GRAVITY, _CENTER = 0.2, 9.8, 0.5


class Acrobot(Physics):
    """Batched pure functions on states [P, 4] (float64)."""

    high = (math.pi, math.pi, 4 * math.pi, 9 * math.pi)
    low = (-math.pi, -math.pi, -4 * math.pi, -9 * math.pi)
    start_low, start_width = (-0.1,) * 4, (0.2,) * 4
    force_bound = 1.0

    def step(self, states: Tensor, actions: Tensor) -> Transition:
        """Apply actions [P, 1]."""
        torque = self.force(actions)
        k1 = _derivatives(states, torque)
        k2 = _derivatives(states + _TIME_STEP / 2 * k1, torque)
        k3 = _derivatives(states + _TIME_STEP / 2 * k2, torque)
        k4 = _derivatives(states + _TIME_STEP * k3, torque)
        theta1, theta2, omega1, omega2 = (states + _TIME_STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)).unbind(1)
        theta1, theta2 = wrap(theta1), wrap(theta2)
        omega1, omega2 = omega1.clamp(self.low[2], self.high[2]), omega2.clamp(self.low[3], self.high[3])
        terminated = -torch.cos(theta1) - torch.cos(theta1 + theta2) > 1
        return Transition(torch.stack([theta1, theta2, omega1, omega2], dim=1), torch.full_like(theta1, -1.0), terminated)


def _derivatives(states: Tensor, torque: Tensor) -> Tensor:
    """Return dstates/dt [P, 4] under torques [P]."""
    theta1, theta2, omega1, omega2 = states.unbind(1)
    sine, cosine = torch.sin(theta2), torch.cos(theta2)
    d1 = _CENTER**2 + (1 + _CENTER**2 + 2 * _CENTER * cosine) + 2
    d2 = _CENTER**2 + _CENTER * cosine + 1
    phi2 = _CENTER * _GRAVITY * torch.cos(theta1 + theta2 - math.pi / 2)
    phi1 = (
        -_CENTER * omega2**2 * sine
        - 2 * _CENTER * omega2 * omega1 * sine
        + (_CENTER + 1) * _GRAVITY * torch.cos(theta1 - math.pi / 2)
        + phi2
    )
    acceleration2 = (torque + d2 / d1 * phi1 - _CENTER * omega1**2 * sine - phi2) / (_CENTER**2 + 1 - d2**2 / d1)
    acceleration1 = -(d2 * acceleration2 + phi1) / d1
    return torch.stack([omega1, omega2, acceleration1, acceleration2], dim=1)
