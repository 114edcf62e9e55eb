"""Any environment registered with Gymnasium, as a population: P copies of it behind Gymnasium's vector interface.

Observations are vectors, actions a bounded Box or Discrete; `agents.environments.discovery` refuses everything else. The copies
never reset by themselves: the successor of a transition is the true one, and `start` resets exactly those that have ended. Each
is reset with a seed drawn from its agent's own random stream, so that an agent alone equals itself in a crowd, as long as the
environment draws its random numbers from the generator that Gymnasium seeds.

The inner state of a copy cannot be saved. A checkpoint holds the seed of its last reset and the actions since, which bring a new
copy there, as long as the environment repeats an episode when it is given the same seed and actions.

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
from agents.lasting import CheckpointError
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
        self._seeds = np.zeros(population, dtype=np.int64)
        self._begun = np.zeros(population, dtype=np.int64)  # places in `_given_since` of the first action of each copy's episode
        self._given_since: list[np.ndarray] = []
        self._observed = np.zeros(0)

    def start(self, stream: RandomStream, step: int, where: Tensor | None = None) -> Tensor:
        """Reset the copies at `where` [P] (bool), or all, and return observations [P, S], those of the others as they were."""
        seeds = stream.integers(Purpose.START_STATE, step, 1, _SEEDS)[:, 0].tolist()
        mask = np.ones(len(seeds), dtype=np.bool_) if where is None else where.cpu().numpy()
        self._reset(np.array(seeds), mask)
        return _observations(self._observed, stream.seeds.device)

    def step(self, states: Tensor, actions: Tensor) -> Transition:
        """Apply actions [P, A] to the copies, whatever `states` says.

        Continuous actions are clipped to the Box. Where an agent has diverged and its action is not finite, it is taken as 0, so
        that its neighbors go on.
        """
        rewards, terminated, truncated = self._step(self._given(actions))
        device = actions.device
        return Transition(
            states=_observations(self._observed, device),
            rewards=torch.tensor(rewards, dtype=torch.float64, device=device),
            terminated=torch.tensor(terminated, device=device),
            truncated=torch.tensor(truncated, device=device),
        )

    def observe(self, states: Tensor) -> Tensor:
        """Return the states, which are observations."""
        return states

    def state_for_checkpoint(self) -> dict[str, Any]:
        """Return the seed of each copy's last reset and its number of actions since [P], the actions, the last observations."""
        given = self._given_since[min(self._begun) :]
        return {
            "seeds": self._seeds,
            "lengths": len(self._given_since) - self._begun,
            "actions": np.stack(given) if given else np.zeros(0),
            "observed": self._observed,
        }

    def restore_from_checkpoint(self, state: dict[str, Any]) -> None:
        """Bring new copies to where others were. Raises CheckpointError where one does not repeat its own episode."""
        seeds, lengths, actions = np.array(state["seeds"]), state["lengths"], np.array(state["actions"])
        self._given_since.clear()
        self._reset(seeds, np.ones(len(seeds), dtype=np.bool_))
        for step, given in enumerate(actions):
            self._reset(seeds, lengths == len(actions) - step)
            _, terminated, truncated = self._step(given)
            waiting = lengths < len(actions) - step - 1  # what they do does not count, but an ended one may not go on
            self._reset(seeds, waiting & (terminated | truncated))
        self._reset(seeds, lengths == 0)
        differ = [i for i, (a, b) in enumerate(zip(self._observed, state["observed"], strict=True)) if a.tobytes() != b.tobytes()]
        if differ:
            raise CheckpointError(
                f"the environment does not repeat its own episode, given its seed and actions (copies {differ})"
            )

    def _reset(self, seeds: np.ndarray, mask: np.ndarray) -> None:
        """Reset the copies at `mask` [P] (bool)."""
        if mask.any():
            self._observed, _ = self._envs.reset(seed=seeds.tolist(), options={"reset_mask": mask})
            self._seeds[mask], self._begun[mask] = seeds[mask], len(self._given_since)
            if (over := min(self._begun)) > len(self._given_since) // 2:
                del self._given_since[:over]
                self._begun -= over

    def _step(self, given: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        self._given_since.append(given)
        self._observed, rewards, terminated, truncated, _ = self._envs.step(given)
        return rewards, terminated, truncated

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
