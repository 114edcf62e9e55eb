"""Any Gymnasium environment as a population: true successors, own random streams, the action spaces."""

import counting_environments  # noqa: F401 (registers environments)
import gymnasium
import numpy as np
import pytest
import torch

import agents
from agents.environments.gymnasium import GymnasiumEnvironment
from agents.hypers import SACHypers
from agents.registry import find_algorithm, find_environment
from agents.replay import Replay
from agents.rng import Purpose, RandomStream
from agents.spaces import Continuous, Discrete


def stream_of(*seeds):
    return RandomStream(torch.tensor(seeds))


def own_seed(stream, agent, step):
    return int(stream.integers(Purpose.START_STATE, step, 1, 2**31)[agent, 0])


def test_module_names_do_not_hide_gymnasium():
    import agents.environments.gymnasium

    assert agents.environments.gymnasium.SyncVectorEnv is gymnasium.vector.SyncVectorEnv


def test_cart_pole_steps_as_gymnasiums_own_copies_with_the_agents_seeds():
    stream = stream_of(3, 1, 4)
    world = GymnasiumEnvironment("CartPole-v1", 3)
    assert world.actions == Discrete(2) and world.observation_size == 4
    copies = [gymnasium.make("CartPole-v1").unwrapped for _ in range(3)]
    states = world.start(stream, 0)
    expected = [copy.reset(seed=own_seed(stream, agent, 0))[0] for agent, copy in enumerate(copies)]
    np.testing.assert_array_equal(states.numpy(), expected)
    episodes = 0
    for step in range(1, 200):
        actions = stream.integers(Purpose.ACTION, step, 1, 2).float()
        transition = world.step(states, actions)
        results = [copy.step(int(action)) for copy, action in zip(copies, actions[:, 0], strict=True)]
        np.testing.assert_array_equal(world.observe(transition.states).numpy(), [result[0] for result in results])
        assert transition.rewards.tolist() == [result[1] for result in results]
        assert transition.terminated.tolist() == [result[2] for result in results]
        assert not transition.truncated.any()
        states, ended = transition.states, transition.terminated
        if ended.any():
            started = world.start(stream, step, ended)
            for agent, copy in enumerate(copies):
                if ended[agent]:
                    np.testing.assert_array_equal(started[agent], copy.reset(seed=own_seed(stream, agent, step))[0])
                    episodes += 1
                else:
                    assert torch.equal(started[agent], states[agent])
            states = started
    assert episodes > 10


def test_discrete_actions_begin_where_the_space_says():
    world = GymnasiumEnvironment("counting/Terminates-v0", 3)
    assert world.actions == Discrete(3)
    states = world.start(stream_of(0, 1, 2), 0)
    assert world.step(states, torch.tensor([[0.0], [1.0], [2.0]])).states[:, 2].tolist() == [5, 6, 7]


def test_continuous_actions_are_clipped_to_the_box():
    world = GymnasiumEnvironment("counting/Box-v0", 3)
    assert world.actions == Continuous((-1.0, 0.0), (1.0, 3.0))
    states = world.start(stream_of(0, 1, 2), 0)
    actions = torch.tensor([[-9.0, -9.0], [0.5, 1.0], [9.0, 9.0]])
    assert world.step(states, actions).states[:, 2].tolist() == [-1, 0.5, 1]


@pytest.mark.parametrize("name", ["counting/Terminates-v0", "counting/Box-v0"])
def test_the_action_of_a_diverged_agent_does_not_stop_its_neighbors(name):
    world = GymnasiumEnvironment(name, 2)
    states = world.start(stream_of(0, 1), 0)
    for bad in (float("nan"), float("inf"), -float("inf")):
        actions = torch.full((2, world.actions.size), 1.0)
        actions[0] = bad
        transition = world.step(states, actions)
    assert transition.states[:, 0].tolist() == [3, 3]
    assert transition.states[:, 2].tolist() == ([5, 6] if name == "counting/Terminates-v0" else [0, 1])


class Spy:
    """Stands in for an algorithm: takes action 0 and learns nothing."""

    def __init__(self, population, task, stream):
        self.shape = (len(population), task.actions.size)

    def act(self, observations, step):
        return torch.zeros(self.shape)

    def update(self, batch, step):
        return torch.zeros(self.shape[0])


@pytest.fixture
def stored(monkeypatch):
    """What the training loop stores: (observation, action, reward, terminated, next observation), one entry a step."""
    entries = []
    monkeypatch.setattr(Replay, "add", lambda self, *transition: entries.append([part.clone() for part in transition]))
    monkeypatch.setattr(Replay, "sample", lambda self, stream, step, size: None)
    monkeypatch.setattr(type(find_algorithm("SAC")), "load", lambda self: Spy)
    return entries


@pytest.mark.parametrize(
    ("name", "cutoff", "length", "ending"),
    [
        ("counting/Terminates-v0", None, 4, 0),
        ("counting/Truncates-v0", None, 4, 1),
        ("counting/Endless-v0", 4, 4, 1),
        ("counting/Limited-v0", None, 30, 1),
        ("counting/Limited-v0", 35, 35, 1),
        ("counting/Terminates-v0", 4, 4, 0),
    ],
)
def test_the_true_successor_is_stored_when_an_episode_ends(stored, name, cutoff, length, ending):
    records = agents.train("SAC", name, [SACHypers()] * 2, [0, 1], steps=2 * length + 2, cutoff=cutoff)
    assert records.length.tolist() == [length, length, 2] * 2
    assert records.ending.tolist() == [ending, ending, 2] * 2
    assert records.episodic_return.tolist() == [length * (length + 1) / 2] * 2 + [3] + [length * (length + 1) / 2] * 2 + [3]
    lucks = set()
    for step, (observations, _, rewards, terminated, successors) in enumerate(stored):
        position = step % length
        assert observations[:, 0].tolist() == [position] * 2
        assert successors[:, 0].tolist() == [position + 1] * 2
        assert torch.equal(observations[:, 1], successors[:, 1])
        assert rewards.tolist() == [position + 1] * 2
        assert terminated.tolist() == [position == length - 1 and ending == 0] * 2
        lucks |= {*observations[:, 1].tolist()}
    assert len(lucks) == 6  # three episodes of two agents, each with a start of its own


@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1"])
def test_an_agent_alone_equals_the_same_agent_in_a_crowd(name):
    hypers = [SACHypers(critic_step_size=10.0 ** -(2 + i % 2), entropy_scale=0.1 * i) for i in range(5)]
    seeds = [3, 1, 4, 1, 5]

    def columns(records, agent):
        mine = records.agent == agent
        return np.stack([getattr(records, column)[mine].astype(float) for column in ("length", "episodic_return", "ending")])

    crowd = agents.train("SAC", name, hypers, seeds, steps=150, cutoff=20)
    for index in (0, 2, 4):
        alone = agents.train("SAC", name, [hypers[index]], [seeds[index]], steps=150, cutoff=20)
        np.testing.assert_array_equal(columns(alone, 0), columns(crowd, index))
    assert not np.array_equal(columns(crowd, 0)[1], columns(crowd, 2)[1])
    assert np.isfinite(crowd.episodic_return).all()


@pytest.mark.parametrize("kind", ["CA", "DA"])
def test_a_built_in_environment_behind_the_adapter_keeps_its_contract(kind):
    find_environment(f"sweep/MountainCar-{kind}-v0")
    world = GymnasiumEnvironment(f"sweep/MountainCar-{kind}-v0", 3)
    direct = find_environment(f"MountainCar-{kind}").make(3)
    states = world.start(stream_of(0, 1, 2), 0)
    assert world.actions == direct.actions
    torch.testing.assert_close(
        world.step(states, torch.ones(3, 1)).states.double(),
        direct.step(states.double(), torch.ones(3, 1)).states,
        rtol=0,
        atol=1e-7,
    )


@pytest.mark.mujoco
def test_half_cheetah_trains_and_equals_gymnasiums_own():
    known = find_environment("HalfCheetah-v5")
    assert known.cutoff == 1000 and known.actions == "continuous"
    stream, world, single = stream_of(7, 8), known.make(2), gymnasium.make("HalfCheetah-v5")
    states = world.start(stream, 0)
    assert world.observation_size == 17 and world.actions == Continuous((-1.0,) * 6, (1.0,) * 6)
    np.testing.assert_array_equal(states[1], single.reset(seed=own_seed(stream, 1, 0))[0].astype(np.float32))
    for step in range(20):
        actions = stream.normals(Purpose.ACTION, step, 6)
        transition = world.step(states, actions)
        observation, reward, terminated, _, _ = single.step(actions[1].clamp(-1, 1).numpy())
        np.testing.assert_array_equal(transition.states[1], observation.astype(np.float32))
        assert (transition.rewards[1].item(), transition.terminated[1].item()) == (reward, terminated)
    crowd = agents.train("SAC", "HalfCheetah-v5", [SACHypers()] * 3, [0, 1, 2], steps=60, cutoff=25)
    alone = agents.train("SAC", "HalfCheetah-v5", [SACHypers()], [1], steps=60, cutoff=25)
    assert crowd.episodic_return[crowd.agent == 1].tolist() == alone.episodic_return.tolist()
    assert crowd.length[crowd.agent == 1].tolist() == [25, 25, 10]
