"""Environments of a user's own, registered with Gymnasium by importing this module: what they do can be counted on fingers."""

from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces


class Counting(gymnasium.Env):
    """Observes (steps in this episode, a random number of the episode, the action taken).

    Terminates after `terminal` steps or truncates by its own rule after `limit`; every step rewards with the step's number.
    """

    metadata: ClassVar = {"render_modes": []}

    def __init__(self, terminal=None, limit=None, action_space=None, observation_space=None):
        self.terminal, self.limit = terminal, limit
        self.action_space = action_space or spaces.Discrete(3, start=5)
        self.observation_space = observation_space or spaces.Box(-np.inf, np.inf, (3,), dtype=np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.luck = 0, self.np_random.random()
        return np.array([0, self.luck, -1.0]), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.steps += 1
        observation = np.array([self.steps, self.luck, float(np.ravel(action)[0])])
        return observation, float(self.steps), self.steps == self.terminal, self.steps == self.limit, {}


def register(env_id, *, max_episode_steps=None, **arguments):
    gymnasium.register(
        env_id, entry_point="counting_environments:Counting", max_episode_steps=max_episode_steps, kwargs=arguments
    )


BOX = spaces.Box(np.float32([-1, 0]), np.float32([1, 3]))
register("counting/Terminates-v0", terminal=4)
register("counting/Truncates-v0", limit=4)
register("counting/Endless-v0")
register("counting/Limited-v0", max_episode_steps=30)
register("counting/Box-v0", terminal=7, action_space=BOX)
register("counting/Unbounded-v0", action_space=spaces.Box(-np.inf, np.inf, (1,)))
register("counting/Matrix-v0", action_space=spaces.Box(-1, 1, (2, 2)))
register("counting/Whole-v0", action_space=spaces.Box(0, 5, (1,), dtype=np.int64))
register("counting/Many-v0", action_space=spaces.MultiDiscrete([2, 3]))
register("counting/Image-v0", observation_space=spaces.Box(0, 255, (8, 8, 3), dtype=np.uint8))
register("counting/Dict-v0", observation_space=spaces.Dict({"position": spaces.Box(0, 1, (2,))}))
gymnasium.register("counting/Broken-v0", entry_point="counting_environments:Absent")
