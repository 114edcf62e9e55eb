"""What Gymnasium knows of an environment by its id: whether agents can be trained on it, and how. Torch-free."""

import importlib
import warnings
from functools import cache
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from agents.environments.registration import IDS
from agents.hypers import ActionKind
from agents.registry import Environment, EnvironmentLookupError

DEFAULT_CUTOFF = 1_000


@cache
def describe(name: str) -> Environment:
    """Return what the registry holds of a Gymnasium environment, or raise EnvironmentLookupError."""
    module, _, env_id = name.rpartition(":")
    if module:
        _import(name, module)
    spec = gymnasium.registry.get(env_id)
    if spec is None:
        raise EnvironmentLookupError(name, "unknown environment", _foreign_ids())
    env = _made(name, env_id)
    try:
        _check_observations(name, env.observation_space)
        kind = _action_kind(name, env.action_space)
    finally:
        env.close()
    cutoff = spec.max_episode_steps or DEFAULT_CUTOFF
    return Environment(name, kind, cutoff, "agents.environments.gymnasium:GymnasiumEnvironment", keeps_state=True)


def make(env_id: str) -> gymnasium.Env[Any, Any]:
    """Return the environment of an id as it is trained on: without a time limit, which is the training loop's."""
    return gymnasium.make(env_id.rpartition(":")[2], max_episode_steps=-1, disable_env_checker=True)


def _foreign_ids() -> tuple[str, ...]:
    return tuple(env_id for env_id in gymnasium.registry if env_id not in IDS.values())


def _import(name: str, module: str) -> None:
    try:
        importlib.import_module(module)
    except Exception as error:  # a user's module may raise anything
        raise EnvironmentLookupError(name, f"module {module} cannot be imported: {type(error).__name__}: {error}") from error


def _made(name: str, env_id: str) -> gymnasium.Env[Any, Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return make(env_id)
    except (ImportError, gymnasium.error.DependencyNotInstalled) as error:
        missing = "mujoco" in str(error).casefold() and find_spec("mujoco") is None
        extra = 'needs the mujoco extra, which is not installed: pip install "sweep-rl[mujoco]"'
        raise EnvironmentLookupError(name, extra if missing else f"cannot be made: {error}") from error
    except Exception as error:
        raise EnvironmentLookupError(name, f"cannot be made: {type(error).__name__}: {error}") from error


def _check_observations(name: str, space: spaces.Space[Any]) -> None:
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        reason = f"observations in {_shown(space)} are not supported, only vectors: Box with one dimension"
        raise EnvironmentLookupError(name, reason)


def _action_kind(name: str, space: spaces.Space[Any]) -> ActionKind:
    if isinstance(space, spaces.Discrete):
        return "discrete"
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating):
        if space.is_bounded():
            return "continuous"
        raise EnvironmentLookupError(name, f"actions in {_shown(space)} are unbounded; a Box of actions must be bounded")
    supported = "Discrete, or a bounded Box of floats with one dimension"
    raise EnvironmentLookupError(name, f"actions in {_shown(space)} are not supported, only {supported}")


def _shown(space: spaces.Space[Any]) -> str:
    return str(space).replace("\n", " ")
