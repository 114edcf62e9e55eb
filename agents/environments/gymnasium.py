"""Any environment registered with Gymnasium, as a population: P copies of it behind Gymnasium's vector interface.

Observations are vectors, actions a bounded Box or Discrete; `agents.environments.discovery` refuses everything else. The copies
never reset by themselves: the successor of a transition is the true one, and `start` resets exactly those that have ended. Each
is reset with a seed drawn from its agent's own random stream, so that an agent alone equals itself in a crowd, as long as the
environment draws its random numbers from the generator that Gymnasium seeds.

The time limit of Gymnasium's registration is taken off and becomes the default cutoff. An environment that truncates by a rule
of its own is respected.
"""

from functools import partial
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor

from agents.environment import Transition
from agents.environments.discovery import describe, make
from agents.rng import Purpose, RandomStream
from agents.spaces import ActionSpace, Continuous, Discrete

_SEEDS = 2**31


class GymnasiumEnvironment:
    """P copies that keep their own state; the states [P, S] handed out are observations (float32)."""

    def __init__(self, name: str, population: int) -> None:
        """Make `population` copies of a registered environment. Raises EnvironmentLookupError."""
        describe(name)
        self._envs = SyncVectorEnv([partial(make, name)] * population, autoreset_mode=AutoresetMode.DISABLED)
        self._space: Any = self._envs.single_action_space
        observation_space: Any = self._envs.single_observation_space
        self.observation_size: int = observation_space.shape[0]
        self.actions = _action_space(self._space)

    def start(self, stream: RandomStream, step: int, where: Tensor | None = None) -> Tensor:
        """Reset the copies at `where` [P] (bool), or all, and return observations [P, S], those of the others as they were."""
        seeds = stream.integers(Purpose.START_STATE, step, 1, _SEEDS)[:, 0].tolist()
        mask = np.ones(len(seeds), dtype=np.bool_) if where is None else where.cpu().numpy()
        observations, _ = self._envs.reset(seed=seeds, options={"reset_mask": mask})
        return _observations(observations, stream.seeds.device)

    def step(self, states: Tensor, actions: Tensor) -> Transition:
        """Apply actions [P, A] to the copies, whatever `states` says.

        Continuous actions are clipped to the Box. Where an agent has diverged and its action is not finite, it is taken as 0, so
        that its neighbors go on.
        """
        observations, rewards, terminated, truncated, _ = self._envs.step(self._given(actions))
        device = actions.device
        return Transition(
            states=_observations(observations, device),
            rewards=torch.tensor(rewards, dtype=torch.float64, device=device),
            terminated=torch.tensor(terminated, device=device),
            truncated=torch.tensor(truncated, device=device),
        )

    def observe(self, states: Tensor) -> Tensor:
        """Return the states, which are observations."""
        return states

    def _given(self, actions: Tensor) -> np.ndarray:
        """Return actions as the environment takes them: of its type, within its space."""
        finite = actions.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0).cpu().numpy()
        if isinstance(self._space, spaces.Discrete):
            indices = np.clip(finite[:, 0].astype(np.int64), 0, self._space.n - 1)
            return self._space.start + indices
        return np.clip(finite.astype(self._space.dtype), self._space.low, self._space.high)


def _action_space(space: Any) -> ActionSpace:
    if isinstance(space, spaces.Discrete):
        return Discrete(int(space.n))
    return Continuous(tuple(space.low.tolist()), tuple(space.high.tolist()))


def _observations(observations: np.ndarray, device: torch.device) -> Tensor:
    return torch.tensor(observations, dtype=torch.float32, device=device)
