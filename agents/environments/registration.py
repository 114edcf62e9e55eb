"""Registers the built-in environments with Gymnasium, as `sweep/Pendulum-CA-v0` and so on. Importing this module does it.

Gymnasium 1 loads no plugins by itself: import this module first, or name it in the id, which does the same:
`gymnasium.make("agents.environments.registration:sweep/Pendulum-CA-v0")`.
"""

import gymnasium

from agents.registry import ENVIRONMENTS

IDS = {name: f"sweep/{name}-v0" for name in ENVIRONMENTS}


def _register() -> None:
    for name, env_id in IDS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="agents.environments.gymnasium_env:BuiltInEnv",
                vector_entry_point="agents.environments.gymnasium_vector_env:BuiltInVectorEnv",
                max_episode_steps=ENVIRONMENTS[name].cutoff,
                kwargs={"name": name},
            )


_register()
