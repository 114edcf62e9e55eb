"""The built-in environments against the published traces, hand-worked values and Gymnasium's own classes."""

import json
import math
from pathlib import Path

import pytest
import torch
from gymnasium.envs.classic_control import AcrobotEnv, Continuous_MountainCarEnv, MountainCarEnv, PendulumEnv

from agents.environments.acrobot import Acrobot
from agents.environments.mountain_car import MountainCar
from agents.environments.pendulum import Pendulum
from agents.registry import ENVIRONMENTS
from agents.rng import RandomStream

TRACES = json.loads((Path(__file__).parent / "data" / "environment_traces.json").read_text())


def row(*numbers):
    return torch.tensor([numbers], dtype=torch.float64)


def run(world, start, steps):
    """States, rewards and terminations under the actions of the published traces."""
    states, history = row(*start), []
    bound = world.actions.high[0] if hasattr(world.actions, "high") else None
    for t in range(steps):
        action = (t // 7) % 3 if bound is None else bound * math.sin(0.37 * t + 0.1)
        transition = world.step(states, row(action))
        states = transition.states
        history.append((states[0].tolist(), transition.rewards[0].item(), transition.terminated[0].item()))
    return history


@pytest.mark.parametrize("trace", TRACES)
def test_the_published_traces_are_reproduced(trace):
    points = TRACES[trace]["trace"]
    world = ENVIRONMENTS[trace.removesuffix("-fast")].make(1)
    history = run(world, TRACES[trace]["start"], points[-1]["n"])
    assert len(points) > 5
    for point in points:
        state, reward, terminated = history[point["n"] - 1]
        assert state == pytest.approx(point["obs"], abs=1e-5)
        assert reward == pytest.approx(point["reward"], abs=1e-5)
        assert terminated == point["done"]


@pytest.mark.parametrize(
    ("world", "start", "steps", "expected"),
    [
        (Pendulum(), (-math.pi, 0.0), 10, (-2.7819322, 0.6538753)),
        (Pendulum(), (1.0, 7.9), 1, (1.4280527, 8.0)),
        (MountainCar(), (-0.5, 0.0), 10, (-0.463303, 0.0051389)),
        (MountainCar("discrete"), (-0.5, 0.0), 10, (-0.5545113, -0.0073948)),
    ],
)
def test_the_published_spot_values_are_reproduced(world, start, steps, expected):
    assert run(world, start, steps)[-1][0] == pytest.approx(expected, abs=1e-6)


def sampled(world, count, seed):
    """States over the whole range, and actions beyond it where they are continuous."""
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(world.low, dtype=torch.float64), torch.tensor(world.high, dtype=torch.float64)
    states = torch.rand(count, len(low), dtype=torch.float64, generator=generator) * (high - low) + low
    if hasattr(world.actions, "high"):
        return states, torch.randn(count, 1, dtype=torch.float64, generator=generator) * world.force_bound
    return states, torch.randint(0, 3, (count, 1), generator=generator).double()


def test_mountain_car_with_discrete_actions_moves_as_gymnasiums_does():
    world, theirs = MountainCar("discrete"), MountainCarEnv()
    states, actions = sampled(world, 2000, 0)
    transition = world.step(states, actions)
    for i in range(len(states)):
        theirs.state = tuple(states[i].tolist())
        _, reward, terminated, _, _ = theirs.step(int(actions[i]))
        assert transition.states[i].tolist() == pytest.approx(list(theirs.state), abs=1e-12)
        assert transition.rewards[i] == reward and transition.terminated[i].item() == terminated
    assert 0 < transition.terminated.sum() < len(states)


def test_mountain_car_with_continuous_actions_moves_as_gymnasiums_does():
    world, theirs = MountainCar(), Continuous_MountainCarEnv()
    states, actions = sampled(world, 2000, 1)
    transition = world.step(states, actions)
    for i in range(len(states)):
        theirs.state = states[i].numpy()
        _, _, terminated, _, _ = theirs.step(actions[i].numpy())  # it keeps its state as float32, and rewards otherwise
        assert transition.states[i].tolist() == pytest.approx(theirs.state.tolist(), abs=1e-7)
        assert transition.terminated[i].item() == terminated
    assert 0 < transition.terminated.sum() < len(states)


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_acrobot_moves_as_gymnasiums_book_equations_do(kind):
    world, theirs = Acrobot(kind), AcrobotEnv()
    states, actions = sampled(world, 1000, 2)
    transition = world.step(states, actions)
    for i in range(len(states)):
        theirs.state = states[i].numpy()
        theirs.AVAIL_TORQUE = [actions[i].clamp(-1, 1).item() if kind == "continuous" else actions[i].item() - 1]
        _, _, terminated, _, _ = theirs.step(0)  # it rewards the terminating step with 0
        assert transition.states[i].tolist() == pytest.approx(theirs.state.tolist(), abs=1e-9)
        assert transition.terminated[i].item() == terminated
    assert 0 < transition.terminated.sum() < len(states)
    assert transition.rewards.unique().tolist() == [-1]


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_pendulum_moves_as_gymnasiums_does_where_the_velocity_is_not_clipped(kind):
    world, theirs = Pendulum(kind), PendulumEnv()
    states, actions = sampled(world, 2000, 3)
    transition = world.step(states, actions)
    compared = 0
    for i in (transition.states[:, 1].abs() < 8).nonzero()[:, 0].tolist():
        theirs.state = states[i].numpy()
        theirs.step(actions[i].numpy() if kind == "continuous" else 2 * (actions[i].numpy() - 1))
        theta, omega = theirs.state
        assert transition.states[i, 1].item() == pytest.approx(omega, abs=1e-12)
        assert math.remainder(transition.states[i, 0].item() - theta, 2 * math.pi) == pytest.approx(0, abs=1e-12)
        assert transition.rewards[i].item() == pytest.approx(math.cos(theta), abs=1e-12)
        compared += 1
    assert compared > 1500
    assert (transition.states[:, 0].abs() <= math.pi).all() and not transition.terminated.any()


def test_mountain_car_ends_at_the_goal_only_when_it_is_not_rolling_back():
    states = torch.tensor([[0.44, 0.03], [0.46, -0.03], [0.40, 0.0]], dtype=torch.float64)
    transition = MountainCar().step(states, torch.ones(3, 1))
    assert transition.terminated.tolist() == [True, False, False]
    assert transition.rewards.tolist() == [-1, -1, -1]


def test_the_goal_of_mountain_car_is_farther_with_discrete_actions():
    state = row(0.44, 0.03)
    assert MountainCar().step(state, row(1)).terminated.item()
    assert not MountainCar("discrete").step(state, row(2)).terminated.item()


def test_mountain_car_stops_at_the_left_wall():
    assert MountainCar().step(row(-1.19, -0.07), row(-1)).states.tolist() == [[-1.2, 0.0]]


@pytest.mark.parametrize("cls", [MountainCar, Pendulum, Acrobot])
def test_actions_outside_the_range_act_as_its_ends(cls):
    state = torch.full((1, len(cls.high)), 0.01, dtype=torch.float64)
    for kind, low, high in (("continuous", -cls.force_bound, cls.force_bound), ("discrete", 0, 2)):
        world = cls(kind)
        assert torch.equal(world.step(state, row(99)).states, world.step(state, row(high)).states)
        assert torch.equal(world.step(state, row(-99)).states, world.step(state, row(low)).states)
        assert not torch.equal(world.step(state, row(high)).states, world.step(state, row(low)).states)


@pytest.mark.parametrize("cls", [MountainCar, Pendulum, Acrobot])
def test_the_middle_discrete_action_is_no_force(cls):
    assert cls("discrete").force(torch.tensor([[0.0], [1.0], [2.0]])).tolist() == [-cls.force_bound, 0, cls.force_bound]


def test_start_states_follow_the_thesis():
    stream = RandomStream(torch.arange(2000))
    car, acrobot = MountainCar().start(stream, 0), Acrobot().start(stream, 0)
    assert -0.6 <= car[:, 0].min() < -0.599 and -0.401 < car[:, 0].max() <= -0.4
    assert not car[:, 1].any()
    assert not torch.equal(car, MountainCar().start(stream, 1))
    assert Pendulum().start(stream, 0).unique(dim=0).tolist() == [[-math.pi, 0.0]]
    assert (acrobot.amin(0) < -0.099).all() and (acrobot.amax(0) > 0.099).all() and (acrobot.abs() <= 0.1).all()
    assert torch.corrcoef(acrobot.T).fill_diagonal_(0).abs().max() < 0.1


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_every_environment_keeps_its_contract(name):
    world = ENVIRONMENTS[name].make(3)
    stream = RandomStream(torch.tensor([0, 1, 2]))
    states = world.start(stream, 0)
    transition = world.step(states, stream.uniforms(0, 0, 1) * 2)
    observations = world.observe(transition.states)
    assert observations.shape == (3, world.observation_size) and observations.dtype == torch.float32
    assert transition.rewards.shape == transition.terminated.shape == (3,)
    assert transition.rewards.dtype == states.dtype == torch.float64
    assert transition.terminated.dtype == torch.bool
    assert transition.states.shape == states.shape
    assert ENVIRONMENTS[name].actions == type(world.actions).__name__.lower()
