"""The built-in environments as Gymnasium environments: checkers, start states, time limits, vectors, drawing."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control import AcrobotEnv, Continuous_MountainCarEnv, MountainCarEnv, PendulumEnv
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from agents.environments.registration import IDS
from agents.registry import ENVIRONMENTS

EVERY_ID = pytest.mark.parametrize("env_id", IDS.values())
NOT_NORMALIZED = ".*symmetric and normalized.*"  # advice: the torque of the pendulum lies in ±2


@pytest.fixture(autouse=True)
def _no_window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def test_every_built_in_environment_is_registered():
    assert list(IDS) == list(ENVIRONMENTS)
    assert all(env_id in gymnasium.registry for env_id in IDS.values())


def test_a_process_that_has_imported_nothing_else_finds_them_by_module_and_id():
    code = "import gymnasium; gymnasium.make('agents.environments.registration:sweep/Pendulum-CA-v0').reset(seed=0)"
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


@EVERY_ID
def test_gymnasiums_checker_accepts_every_id(env_id):
    pytest.importorskip("pygame")
    with warnings.catch_warnings():
        if env_id == "sweep/Pendulum-CA-v0":
            warnings.filterwarnings("ignore", NOT_NORMALIZED)
        check_env(gymnasium.make(env_id).unwrapped)


@EVERY_ID
def test_the_checker_of_stable_baselines_accepts_every_id(env_id):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        if env_id == "sweep/Pendulum-CA-v0":
            warnings.filterwarnings("ignore", NOT_NORMALIZED)
        checker.check_env(gymnasium.make(env_id))


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_step_from_a_given_state_is_that_of_the_batched_functions(name):
    env, world = gymnasium.make(IDS[name]), ENVIRONMENTS[name].make(1)
    state = [0.25 * bound for bound in world.high]
    observation, _ = env.reset(options={"state": state})
    np.testing.assert_array_equal(observation, np.float32(state))
    for action in (0, 2) if world.actions.size == 1 and ENVIRONMENTS[name].actions == "discrete" else (-0.5, 9.0):
        env.reset(options={"state": state})
        given = action if ENVIRONMENTS[name].actions == "discrete" else np.float32([action])
        observation, reward, terminated, truncated, _ = env.step(given)
        expected = world.step(torch.tensor([state], dtype=torch.float64), torch.tensor([[action]], dtype=torch.float64))
        np.testing.assert_array_equal(observation, expected.states[0].float().numpy())
        assert (reward, terminated, truncated) == (expected.rewards.item(), expected.terminated.item(), False)


@EVERY_ID
def test_the_same_seed_starts_the_same_and_within_the_box_of_starts(env_id):
    env = gymnasium.make(env_id)
    first, again, other = (env.reset(seed=seed)[0] for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert np.array_equal(first, other) == ("Pendulum" in env_id)
    low = np.array(env.unwrapped.physics.start_low)
    high = low + env.unwrapped.physics.start_width
    drawn = np.stack([env.reset()[0] for _ in range(200)])
    assert (drawn >= np.float32(low)).all() and (drawn <= np.float32(high)).all()
    assert (np.ptp(drawn, axis=0) >= 0.9 * (high - low)).all()


@pytest.mark.parametrize("state", [[0.0], [[0.0, 0.0]], [0.0, 0.2], [-2.0, 0.0], [0.0, float("nan")]])
def test_a_start_state_that_is_none_is_refused(state):
    env = gymnasium.make(IDS["MountainCar-CA"])
    with pytest.raises(ValueError, match=r'options\["state"\].*must be 2 numbers within'):
        env.reset(options={"state": state})


@pytest.mark.parametrize("action", [3, -1, 0.5])
def test_a_discrete_action_that_is_none_is_refused(action):
    env = gymnasium.make(IDS["MountainCar-DA"], disable_env_checker=True)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="is not in Discrete"):
        env.step(action)


def test_an_episode_is_truncated_after_a_thousand_steps_and_not_terminated():
    env = gymnasium.make(IDS["Pendulum-DA"])
    env.reset(seed=0)
    endings = [env.step(1)[2:4] for _ in range(1000)]
    assert endings == [(False, False)] * 999 + [(False, True)]


@EVERY_ID
def test_a_vector_environment_equals_single_ones(env_id):
    vector = gymnasium.make_vec(env_id, num_envs=5, max_episode_steps=37)
    single = gymnasium.make_vec(env_id, num_envs=5, max_episode_steps=37, vectorization_mode="sync")
    assert type(vector.unwrapped).__name__ == "BuiltInVectorEnv" and type(single.unwrapped).__name__ == "SyncVectorEnv"
    assert vector.action_space == single.action_space and vector.observation_space == single.observation_space
    np.testing.assert_array_equal(vector.reset(seed=11)[0], single.reset(seed=11)[0])
    single.action_space.seed(0)
    ends = 0
    for _ in range(120):
        actions = single.action_space.sample()
        ours, theirs = vector.step(actions), single.step(actions)
        for mine, other in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_array_equal(mine, other)
            assert mine.dtype == other.dtype
        ends += ours[2].sum() + ours[3].sum()
    assert ends >= 15


def test_a_vector_environment_terminates_and_begins_anew_as_single_ones_do():
    options = {"state": [0.49, 0.05]}
    vector = gymnasium.make_vec(IDS["MountainCar-DA"], num_envs=3)
    vector.reset(seed=0, options=options)
    assert vector.step(np.array([2, 2, 2]))[2].tolist() == [True] * 3
    observations, rewards, terminated, _, _ = vector.step(np.array([2, 2, 2]))
    assert rewards.tolist() == [0] * 3 and not terminated.any()
    assert (observations[:, 0] < -0.39).all() and len(set(observations[:, 0])) == 3


def test_a_vector_environment_without_autoreset_resets_what_the_mask_says():
    vector = gymnasium.make_vec(IDS["MountainCar-CA"], num_envs=3, autoreset_mode=AutoresetMode.DISABLED, max_episode_steps=2)
    vector.reset(seed=1)
    vector.step(np.zeros((3, 1)))
    observations, _, _, truncated, _ = vector.step(np.zeros((3, 1)))
    assert truncated.all()
    with pytest.raises(ValueError, match="have ended"):
        vector.step(np.zeros((3, 1)))
    mask = np.array([True, False, True])
    restarted, _ = vector.reset(seed=[4, 5, 6], options={"reset_mask": mask})
    np.testing.assert_array_equal(restarted[1], observations[1])
    assert (restarted[mask, 1] == 0).all()
    single = gymnasium.make(IDS["MountainCar-CA"])
    np.testing.assert_array_equal(restarted[2], single.reset(seed=6)[0])
    vector.reset(options={"reset_mask": ~mask})
    assert not vector.step(np.zeros((3, 1)))[3].any()
    with pytest.raises(ValueError, match="SameStep"):
        gymnasium.make_vec(IDS["MountainCar-CA"], autoreset_mode="SameStep")
    with pytest.raises(ValueError, match="render_mode"):
        gymnasium.make_vec(IDS["MountainCar-CA"], render_mode="rgb_array")


THEIRS = {
    "Acrobot-CA": (AcrobotEnv, [1.0, 0.5, 0.0, 0.0]),
    "Acrobot-DA": (AcrobotEnv, [1.0, 0.5, 0.0, 0.0]),
    "MountainCar-CA": (Continuous_MountainCarEnv, [0.3, 0.0]),
    "MountainCar-DA": (MountainCarEnv, [0.3, 0.0]),
    "Pendulum-CA": (PendulumEnv, [1.0, 0.0]),
    "Pendulum-DA": (PendulumEnv, [1.0, 0.0]),
}


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_picture_is_that_of_gymnasiums_environment_in_the_same_state(name):
    pytest.importorskip("pygame")
    cls, state = THEIRS[name]
    env, theirs = gymnasium.make(IDS[name], render_mode="rgb_array"), cls(render_mode="rgb_array")
    theirs.reset(seed=0)
    theirs.state = np.array(state)
    env.reset(options={"state": state})
    picture = env.render()
    np.testing.assert_array_equal(picture, theirs.render())
    assert len(np.unique(picture)) > 2
    for _ in range(5):
        env.step(env.action_space.sample())
    assert not np.array_equal(env.render(), picture)
    assert env.metadata["render_fps"] == cls.metadata["render_fps"]
    env.close()


def test_the_pendulums_arrow_shows_the_torque():
    pytest.importorskip("pygame")
    pictures = []
    for action in (0, 1, 2):
        env = gymnasium.make(IDS["Pendulum-DA"], render_mode="rgb_array")
        env.reset(options={"state": [0.0, 0.0]})
        env.step(action)
        env.unwrapped.state = np.zeros(2)
        pictures.append(env.render())
        env.close()
    assert not np.array_equal(pictures[0], pictures[2]) and not np.array_equal(pictures[0], pictures[1])


@EVERY_ID
def test_human_rendering_draws_at_every_step(env_id, monkeypatch):
    pygame = pytest.importorskip("pygame")
    flips = []
    monkeypatch.setattr(pygame.display, "flip", lambda: flips.append(1))
    env = gymnasium.make(env_id, render_mode="human")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    assert len(flips) == 2


def test_rendering_without_pygame_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = gymnasium.make(IDS["Pendulum-CA"], render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(gymnasium.error.DependencyNotInstalled, match=r"pip install .*sweep-rl\[render\]"):
        env.render()
