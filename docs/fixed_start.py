"""Acrobot as the thesis' published code starts it: at rest, hanging straight down, in every episode. Else as `Acrobot-CA`.

For the study `fixed-start.toml` beside it: does the start explain what VanillaAC does on Acrobot-CA? (docs/reproduction.md)
"""

from math import cos, pi, sin

import gymnasium
import numpy as np
from gymnasium import spaces

_STEP, _MOST = 0.2, (4 * pi, 9 * pi)


class FixedStartAcrobot(gymnasium.Env):
    """The physics of section 5.1, in plain numbers: lengths, masses and inertias 1, centres of mass 0.5, gravity 9.8."""

    def __init__(self) -> None:
        high = np.array([pi, pi, *_MOST], np.float32)
        self.observation_space = spaces.Box(-high, high, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.state = (0.0, 0.0, 0.0, 0.0)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = tuple(map(float, (options or {}).get("state", (0.0, 0.0, 0.0, 0.0))))
        return np.array(self.state, np.float32), {}

    def step(self, action):
        torque = min(1.0, max(-1.0, float(action[0])))
        angle, other, velocity, rate = _runge_kutta(self.state, torque)
        self.state = (_wrapped(angle), _wrapped(other), _clipped(velocity, _MOST[0]), _clipped(rate, _MOST[1]))
        is_up = -cos(self.state[0]) - cos(self.state[0] + self.state[1]) > 1
        return np.array(self.state, np.float32), -1.0, is_up, False, {}


def _derivatives(state, torque):
    angle, other, velocity, rate = state
    d1 = 0.25 + (1 + 0.25 + cos(other)) + 2
    d2 = 0.25 + 0.5 * cos(other) + 1
    phi2 = 0.5 * 9.8 * cos(angle + other - pi / 2)
    phi1 = -0.5 * rate**2 * sin(other) - rate * velocity * sin(other) + 1.5 * 9.8 * cos(angle - pi / 2) + phi2
    change = (torque + d2 / d1 * phi1 - 0.5 * velocity**2 * sin(other) - phi2) / (1.25 - d2**2 / d1)
    return velocity, rate, -(d2 * change + phi1) / d1, change


def _runge_kutta(state, torque):
    k1 = _derivatives(state, torque)
    k2 = _derivatives([s + _STEP / 2 * k for s, k in zip(state, k1, strict=True)], torque)
    k3 = _derivatives([s + _STEP / 2 * k for s, k in zip(state, k2, strict=True)], torque)
    k4 = _derivatives([s + _STEP * k for s, k in zip(state, k3, strict=True)], torque)
    return [s + _STEP / 6 * (a + 2 * b + 2 * c + d) for s, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)]


def _wrapped(angle):
    return (angle + pi) % (2 * pi) - pi


def _clipped(value, most):
    return min(most, max(-most, value))


gymnasium.register("FixedStartAcrobot-CA-v0", FixedStartAcrobot, max_episode_steps=1_000)
