"""A built-in environment as a Gymnasium environment: the batched functions with a batch of one, and Gymnasium's own drawing.

`reset(seed=…)` draws the start state from Gymnasium's generator; `reset(options={"state": […]})` starts from a state.
"""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.classic_control import AcrobotEnv, Continuous_MountainCarEnv, MountainCarEnv, PendulumEnv
from gymnasium.error import DependencyNotInstalled
from torch import Tensor

from agents.environments.physics import Physics
from agents.registry import ENVIRONMENTS
from agents.spaces import Discrete

#: The environments of Gymnasium's that draw the same thing (Mountain Car's goal differs between the kinds of actions).
_RENDERERS: dict[str, Any] = {
    "Acrobot-CA": AcrobotEnv,
    "Acrobot-DA": AcrobotEnv,
    "MountainCar-CA": Continuous_MountainCarEnv,
    "MountainCar-DA": MountainCarEnv,
    "Pendulum-CA": PendulumEnv,
    "Pendulum-DA": PendulumEnv,
}


class BuiltInEnv(gymnasium.Env[np.ndarray, Any]):
    """One copy of a built-in environment. `state` is its state, float64 [S]."""

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}  # noqa: RUF012 (as Gymnasium declares it)

    def __init__(self, name: str, render_mode: str | None = None) -> None:
        """Take the built-in environment's name. Rendering needs pygame (the `render` extra)."""
        self.physics: Physics = ENVIRONMENTS[name].make(1)
        self.observation_space, self.action_space = observation_space(self.physics), action_space(self.physics)
        self.render_mode = render_mode
        self._renderer = _RENDERERS[name](render_mode=render_mode)
        self.metadata = self.metadata | {"render_fps": self._renderer.metadata["render_fps"]}
        self.state = np.zeros(self.physics.observation_size)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the first observation, of a start state that is drawn, or of `options["state"]`."""
        super().reset(seed=seed)
        self.state = start_state(self.physics, self.np_random, options)
        self._renderer.last_u = None
        if self.render_mode == "human":
            self.render()
        return self._observation(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply an action: continuous ones are clipped to the action space, discrete ones must lie in it."""
        if isinstance(self.action_space, spaces.Discrete) and not self.action_space.contains(action):
            raise ValueError(f"action {action!r} is not in {self.action_space}")
        actions = as_actions(np.reshape(action, (1, 1)))
        transition = self.physics.step(torch.from_numpy(self.state[None]), actions)
        self.state = transition.states[0].numpy()
        self._renderer.last_u = self.physics.force(actions).item()
        if self.render_mode == "human":
            self.render()
        return self._observation(), transition.rewards.item(), bool(transition.terminated), False, {}

    def render(self) -> Any:
        """Draw the state as Gymnasium's environment of that name does. Raises DependencyNotInstalled without pygame."""
        self._renderer.spec, self._renderer.state = self.spec, self.state
        try:
            return self._renderer.render()
        except DependencyNotInstalled as error:
            raise DependencyNotInstalled('rendering needs pygame: pip install "sweep-rl[render]"') from error

    def close(self) -> None:
        """Close the window, if there is one."""
        self._renderer.close()

    def _observation(self) -> np.ndarray:
        return self.physics.observe(torch.from_numpy(self.state[None]))[0].numpy()


def observation_space(physics: Physics) -> spaces.Box:
    """Return the box of observations."""
    return spaces.Box(np.array(physics.low, dtype=np.float32), np.array(physics.high, dtype=np.float32))


def action_space(physics: Physics) -> spaces.Space[Any]:
    """Return the space of actions."""
    if isinstance(physics.actions, Discrete):
        return spaces.Discrete(physics.actions.count)
    return spaces.Box(np.array(physics.actions.low, dtype=np.float32), np.array(physics.actions.high, dtype=np.float32))


def start_state(physics: Physics, generator: np.random.Generator, options: dict[str, Any] | None) -> np.ndarray:
    """Return a start state [S] (float64), drawn or as `options["state"]` says. Raises ValueError for a state that is none."""
    if options is None or "state" not in options:
        return physics.start_at(torch.from_numpy(generator.random((1, physics.observation_size))))[0].numpy()
    state = np.array(options["state"], dtype=np.float64)
    if state.shape != (physics.observation_size,) or not observation_space(physics).contains(state.astype(np.float32)):
        raise ValueError(
            f'options["state"] = {options["state"]!r}: must be {physics.observation_size} numbers within '
            f"{list(physics.low)} and {list(physics.high)}"
        )
    return state


def as_actions(actions: np.ndarray) -> Tensor:
    """Return actions [P, 1] as the batched functions take them."""
    return torch.from_numpy(actions.astype(np.float64))
