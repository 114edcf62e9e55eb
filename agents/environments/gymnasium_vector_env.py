"""A built-in environment as a Gymnasium vector environment: one call of the batched functions steps all copies.

Copy i is seeded with `seed` + i, and each equals the single environment with that seed.
"""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from agents.environments.gymnasium_env import BuiltInEnv, action_space, as_actions, observation_space, start_state
from agents.environments.physics import Physics
from agents.registry import ENVIRONMENTS


class BuiltInVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """`num_envs` copies of a built-in environment. `states` are their states, float64 [P, S]."""

    def __init__(
        self,
        name: str,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ) -> None:
        """Truncate episodes after `max_episode_steps`. The autoreset mode is Gymnasium's default, or disabled."""
        self._mode = AutoresetMode(autoreset_mode)
        if self._mode is AutoresetMode.SAME_STEP:
            raise ValueError("autoreset_mode: SameStep is not supported; NextStep and Disabled are")
        if render_mode is not None:
            raise ValueError('render_mode: batched copies are not drawn; use vectorization_mode="sync"')
        self.physics: Physics = ENVIRONMENTS[name].make(num_envs)
        self.num_envs = num_envs
        self.metadata = BuiltInEnv.metadata | {"autoreset_mode": self._mode}
        self.single_observation_space, self.single_action_space = observation_space(self.physics), action_space(self.physics)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.states = np.zeros((num_envs, self.physics.observation_size))
        self._limit = max_episode_steps
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._generators = [np_random()[0] for _ in range(num_envs)]

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Reset all copies, or those of `options["reset_mask"]`, to drawn states or to `options["state"]`."""
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=np.bool_))
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed or [None] * self.num_envs
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self._generators[i] = np_random(seeds[i])[0]
        self._restart(mask, options)
        return self._observations(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply actions [P] or [P, 1]; where the last step ended an episode, start the next one instead."""
        begun = self._ended.copy()
        if self._mode is AutoresetMode.DISABLED and begun.any():
            raise ValueError(f"copies {np.flatnonzero(begun).tolist()} have ended: reset them first")
        transition = self.physics.step(torch.from_numpy(self.states), as_actions(np.reshape(actions, (self.num_envs, 1))))
        self.states = transition.states.numpy()
        self._elapsed += 1
        truncated = np.full(self.num_envs, False) if self._limit is None else self._elapsed >= self._limit
        rewards, terminated = transition.rewards.numpy(), transition.terminated.numpy()
        if begun.any():
            self._restart(begun, None)
            rewards, terminated, truncated = np.where(begun, 0.0, rewards), terminated & ~begun, truncated & ~begun
        self._ended = terminated | truncated
        return self._observations(), rewards, terminated, truncated, {}

    def _restart(self, mask: np.ndarray, options: dict[str, Any] | None) -> None:
        for i in np.flatnonzero(mask):
            self.states[i] = start_state(self.physics, self._generators[i], options)
        self._elapsed[mask] = 0
        self._ended[mask] = False

    def _observations(self) -> np.ndarray:
        return self.physics.observe(torch.from_numpy(self.states)).numpy()
