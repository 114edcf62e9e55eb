"""An environment whose observations are wide, so that a replay buffer is large after a few thousand steps."""

import gymnasium
import numpy as np
from gymnasium import spaces

WIDTH = 250


class Wide(gymnasium.Env):
    """Noise of WIDTH numbers a step, whatever one does."""

    observation_space = spaces.Box(-1, 1, (WIDTH,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action):
        return self._observation(), float(action), False, False, {}

    def _observation(self):
        return self.np_random.random(WIDTH, dtype=np.float32)


gymnasium.register("wide/Noise-v0", entry_point="wide_environments:Wide", max_episode_steps=500)
