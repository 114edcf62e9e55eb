"""Algorithms and environments of one's own, and captured steps, go on from a saved state as built-in ones do."""

import contextlib
import random
import types

import counting_environments
import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from recorded_graph import RecordedGraph
from resumed_runs import BATCH, PAIRS, STEPS, assert_same, check_resumed, copied, make, saved_at

from agents import kernels
from agents.checkpoint import CheckpointError
from agents.environments.gymnasium import GymnasiumEnvironment
from agents.hypers import ActorCriticHypers
from agents.rng import RandomStream


class Counting:
    """Learns nothing, but its actions depend on all that it keeps, in every form that it keeps it."""

    hypers, actions = ActorCriticHypers, ("continuous",)

    def __init__(self, population, task, stream):
        self.population, self.stream, self.size = population, stream, len(population)
        self.counter, self.factors = 0, {"a": 1.0, 3: [torch.zeros(self.size)]}
        self.history, self.previous, self.array = [], None, np.zeros((2, self.size))
        self.current = torch.zeros(self.size, task.observation_size)
        self.generator = np.random.default_rng(5)

    def act(self, observations, step):
        self.counter += 1
        self.factors["a"] *= 0.99
        self.factors[3][0] += observations[:, 0]
        self.previous, self.current = self.current, observations
        self.history = [*self.history[-2:], observations[:, 1].clone()]
        self.array[self.counter % 2] += self.generator.random()
        total = torch.stack(self.history).sum(0) + self.factors[3][0] * self.factors["a"] + self.previous.sum(1)
        total += torch.from_numpy(self.array).sum(0).float() + self.counter
        return total.sin().unsqueeze(1)

    def update(self, batch, step):
        return torch.zeros(self.size)


class WithRandomness(Counting):
    """Keeps what cannot be saved."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.tools = {"dice": random.Random(1)}


class WithItsOwnWay(WithRandomness):
    """Says itself what is to be saved."""

    def act(self, observations, step):
        return super().act(observations, step) + self.tools["dice"].random()

    def state_for_checkpoint(self):
        version, numbers, following = self.tools["dice"].getstate()
        kept = {name: getattr(self, name) for name in ("counter", "factors", "history", "previous", "array", "current")}
        return {"dice": [version, np.array(numbers), following], "generator": self.generator.bit_generator.state, **kept}

    def restore_from_checkpoint(self, state):
        version, numbers, following = state.pop("dice")
        self.tools["dice"].setstate((version, tuple(numbers.tolist()), following))
        self.generator.bit_generator.state = state.pop("generator")
        for name, value in state.items():
            setattr(self, name, np.array(value) if isinstance(value, np.ndarray) else value)


class WithACache(WithRandomness):
    """Names what need not be saved."""

    not_in_checkpoints = ("tools",)


def test_an_algorithm_of_ones_own_resumes_whatever_it_keeps():
    check_resumed(f"{__name__}:Counting", "MountainCar-CA")
    check_resumed(f"{__name__}:WithItsOwnWay", "MountainCar-CA", places=(1, 47))
    check_resumed(f"{__name__}:WithACache", "MountainCar-CA", places=(47,))


def test_what_cannot_be_saved_is_named():
    run = make(f"{__name__}:WithRandomness", "MountainCar-CA")
    with pytest.raises(CheckpointError, match=r"^lockstep\.agents\.tools\['dice'\]: a random\.Random cannot be saved"):
        run.state()


def test_a_gymnasium_environment_is_brought_back_by_its_own_actions():
    """An untrained agent's pole falls after some ten steps, at other times for each copy."""
    uninterrupted = check_resumed("SAC", "CartPole-v1", cutoff=30, places=(1, 10, 24, 47, 70, 89))
    ends = [set(uninterrupted.finish().first_step[uninterrupted.finish().agent == agent]) for agent in range(3)]
    assert len(ends[0]) > 3 and ends[0] != ends[1] != ends[2]


@pytest.mark.mujoco
def test_so_is_one_with_an_inner_state_that_observations_do_not_show():
    check_resumed("SAC", "HalfCheetah-v5", cutoff=35, places=(1, 34, 35, 36, 47))


def test_only_the_actions_of_the_present_episodes_are_kept():
    world, stream = GymnasiumEnvironment("counting/Terminates-v0", 2), RandomStream(torch.tensor([0, 1]))
    world.start(stream, 0)
    for step in range(1, 101):
        ended = world.step(torch.zeros(2, 3), torch.zeros(2, 1)).terminated
        if ended.any():
            world.start(stream, step, ended)
        if step == 2:
            world.start(stream, step, torch.tensor([True, False]))
        assert len(world._given_since) <= 8
    state = world.state_for_checkpoint()
    assert state["lengths"].tolist() == [2, 0] and len(state["actions"]) == 2


class Forgetful(counting_environments.Counting):
    """Its episodes are not what seed and actions make of them."""

    count = 0

    def step(self, action):
        Forgetful.count += 1
        observation, *rest = super().step(action)
        observation[1] = Forgetful.count
        return observation, *rest


gymnasium.register("counting/Forgetful-v0", entry_point=Forgetful, kwargs={"action_space": spaces.Box(-1, 1, (1,))})


def test_an_environment_that_does_not_repeat_itself_is_not_gone_on_with():
    run = make("SAC", "counting/Forgetful-v0")
    run.advance(10)
    with pytest.raises(
        CheckpointError, match=r"does not repeat its own episode, given its seed and actions \(copies \[0, 1, 2\]\)"
    ):
        make("SAC", "counting/Forgetful-v0").restore(copied(run.state()))


class GraphOnTheHost:
    """Stands in for a CUDA graph. Recording has taken the step already, so that the first replay has nothing to do."""

    def __init__(self):
        self.recorded, self.replays = RecordedGraph(), 0

    def replay(self):
        if self.replays:
            self.recorded.replay()
        self.replays += 1


@pytest.fixture
def captured(monkeypatch):
    """Make runs whose steps are captured and replayed as on a GPU."""
    stream = types.SimpleNamespace(wait_stream=lambda other: None)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: stream)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: contextlib.nullcontext())
    monkeypatch.setattr(torch.cuda, "CUDAGraph", GraphOnTheHost)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, stream: graph.recorded)

    def make_captured(*arguments, **keywords):
        run = make(*arguments, **keywords)
        run._lockstep._captured, run._lockstep._side = True, stream
        return run

    with kernels.using("torch"):
        yield make_captured


@pytest.mark.parametrize(("algorithm", "environment"), PAIRS)
def test_a_resumed_population_is_captured_anew_and_equals_one_that_took_its_steps_one_by_one(algorithm, environment, captured):
    uninterrupted, interrupted = make(algorithm, environment), captured(algorithm, environment)
    uninterrupted.advance(STEPS)
    for place, state in saved_at(interrupted, (10, 50)).items():
        resumed = captured(algorithm, environment)
        resumed.restore(state)
        resumed.advance(STEPS - place)
        assert resumed._lockstep._graph.replays > 30
        assert_same(uninterrupted, resumed)
    assert_same(uninterrupted, interrupted)


@pytest.mark.gpu
@pytest.mark.parametrize(("algorithm", "environment"), PAIRS)
def test_a_population_resumes_on_a_gpu(algorithm, environment):
    check_resumed(algorithm, environment, places=(10, BATCH, 47), device="cuda")
