import json
import math
from pathlib import Path

import pytest
import torch

from agents.environments.mountain_car import MountainCar
from agents.environments.pendulum import Pendulum
from agents.registry import ENVIRONMENTS
from agents.rng import RandomStream

TRACES = json.loads((Path(__file__).parent / "data" / "environment_traces.json").read_text())


def run(world, start, bound, steps):
    """States, rewards and terminations under the actions of the published traces, bound · sin(0.37 t + 0.1)."""
    states, history = torch.tensor([start], dtype=torch.float64), []
    for t in range(steps):
        transition = world.step(states, torch.tensor([[bound * math.sin(0.37 * t + 0.1)]], dtype=torch.float64))
        states = transition.states
        history.append((states[0].tolist(), transition.rewards[0].item(), transition.terminated[0].item()))
    return history


@pytest.mark.parametrize("name", ["Pendulum-CA", "Pendulum-CA-fast"])
def test_pendulum_reproduces_the_published_traces(name):
    history = run(Pendulum(), TRACES[name]["start"], 2, 300)
    for point in TRACES[name]["trace"]:
        state, reward, terminated = history[point["n"] - 1]
        assert state == pytest.approx(point["obs"], abs=1e-5)
        assert reward == pytest.approx(point["reward"], abs=1e-5)
        assert terminated == point["done"]


def test_mountain_car_reproduces_the_published_spot_value():
    state, reward, _ = run(MountainCar(), [-0.5, 0.0], 1, 10)[-1]
    assert state == pytest.approx([-0.463303, 0.0051389], abs=1e-6)
    assert reward == -1


def test_pendulum_moves_with_the_velocity_before_it_is_clipped():
    state = Pendulum().step(torch.tensor([[1.0, 7.9]], dtype=torch.float64), torch.tensor([[2 * math.sin(0.1)]])).states
    assert state[0].tolist() == pytest.approx([1.4280527, 8.0], abs=1e-6)


def test_mountain_car_ends_at_the_goal_only_when_it_is_not_rolling_back():
    states = torch.tensor([[0.44, 0.03], [0.46, -0.03], [0.40, 0.0]], dtype=torch.float64)
    transition = MountainCar().step(states, torch.ones(3, 1))
    assert transition.terminated.tolist() == [True, False, False]
    assert transition.rewards.tolist() == [-1, -1, -1]


def test_mountain_car_stops_at_the_left_wall():
    transition = MountainCar().step(torch.tensor([[-1.19, -0.07]], dtype=torch.float64), -torch.ones(1, 1))
    assert transition.states.tolist() == [[-1.2, 0.0]]


def test_actions_outside_the_range_act_as_its_ends():
    for world, end in ((MountainCar(), 1.0), (Pendulum(), 2.0)):
        state = torch.tensor([[-0.5, 0.01]], dtype=torch.float64)
        assert torch.equal(world.step(state, torch.tensor([[9.0]])).states, world.step(state, torch.tensor([[end]])).states)


def test_start_states_follow_the_thesis():
    stream = RandomStream(torch.arange(2000))
    car = MountainCar().start(stream, 0)
    assert -0.6 <= car[:, 0].min() < -0.599 and -0.401 < car[:, 0].max() <= -0.4
    assert not car[:, 1].any()
    assert not torch.equal(car, MountainCar().start(stream, 1))
    assert Pendulum().start(stream, 0).unique(dim=0).tolist() == [[-math.pi, 0.0]]


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_every_environment_keeps_its_contract(name):
    world = ENVIRONMENTS[name].make(3)
    stream = RandomStream(torch.tensor([0, 1, 2]))
    states = world.start(stream, 0)
    transition = world.step(states, stream.normals(0, 0, 1))
    observations = world.observe(transition.states)
    assert observations.shape == (3, world.observation_size) and observations.dtype == torch.float32
    assert transition.rewards.shape == transition.terminated.shape == (3,)
    assert transition.terminated.dtype == torch.bool
    assert transition.states.shape == states.shape
