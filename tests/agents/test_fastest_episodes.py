"""How fast Mountain Car can be solved at all: 65 steps with continuous actions, 83 with discrete ones (thesis, Table 6.1).

That no policy is faster is shown for every start in [−0.6, −0.4] and every sequence of forces in [−1, 1] at once, the discrete
ones among them. Positions are cut into bins; each bin holds an interval of velocities that contains every velocity reachable
there. One step carries bins to bins: a state whose new velocity is v moves by v, so from bin i it can come to bin i + k only with
v between (k − 1) and (k + 1) widths. What is carried along is never smaller than what can be reached; as long as it stays left of
the goal, so does every car. That the bound is attained is shown by driving the environment there with bang-bang forces.
"""

import math

import numpy as np
import pytest
import torch

from agents.environments.mountain_car import MountainCar

pytestmark = pytest.mark.slow

_ROUNDING = 1e-12


def farthest_positions(world, steps, width=5e-5):
    """A position that no car has passed after each of the steps, from an interval of velocities [low, high] a bin."""
    count = round(1.8 / width)
    edges = -1.2 + width * np.arange(count + 1)
    cosine = np.cos(3 * edges)
    least, most = np.minimum(cosine[:-1], cosine[1:]), np.maximum(cosine[:-1], cosine[1:])
    most[(edges[:-1] < 0) & (edges[1:] >= 0)] = 1
    least[(edges[:-1] < -math.pi / 3) & (edges[1:] >= -math.pi / 3)] = -1
    started = (edges[1:] >= -0.6 - _ROUNDING) & (edges[:-1] <= -0.4 + _ROUNDING)
    low, high = np.where(started, 0.0, np.inf), np.where(started, 0.0, -np.inf)
    farthest = []
    for _ in range(steps):
        slowest = np.clip(low - world.power - 0.0025 * most - _ROUNDING, -0.07, 0.07)
        fastest = np.clip(high + world.power - 0.0025 * least + _ROUNDING, -0.07, 0.07)
        reached = low <= high
        farthest.append((edges[1:] + fastest)[reached].max())
        low, high = carried(np.where(reached, slowest, np.inf), np.where(reached, fastest, -np.inf), width)
    return farthest


def carried(slowest, fastest, width):
    """The intervals after every bin's cars have moved with their new velocities."""
    count = len(slowest)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    reached = slowest <= fastest
    offsets = range(math.floor(slowest[reached].min() / width) - 1, math.ceil(fastest[reached].max() / width) + 2)
    for k in offsets:
        bottom, top = np.maximum(slowest, (k - 1) * width - _ROUNDING), np.minimum(fastest, (k + 1) * width + _ROUNDING)
        possible = bottom <= top
        if k < 0 and possible[:-k].any():  # the left wall: such a car stands still in the first bin
            low[0], high[0] = min(low[0], 0), max(high[0], 0)
        source = slice(max(0, -k), min(count, count - k))
        target = slice(max(0, k), min(count, count + k))
        np.minimum(low[target], np.where(possible, bottom, np.inf)[source], out=low[target])
        np.maximum(high[target], np.where(possible, top, -np.inf)[source], out=high[target])
    return low, high


def fastest_bang_bang(world, actions):
    """Steps to the goal of the fastest of many policies: one end of the force, the other, then the first again."""
    start, swap, first, second = np.meshgrid(np.linspace(-0.6, -0.4, 201), [0, 1], np.arange(45), np.arange(45))
    swap, first, second = swap.ravel(), first.ravel(), second.ravel()
    states = torch.from_numpy(np.stack([start.ravel(), np.zeros(start.size)], axis=1))
    for step in range(100):
        middle = (step >= first) & (step < first + second)
        chosen = np.where(middle ^ (swap == 1), actions[0], actions[1])
        transition = world.step(states, torch.from_numpy(chosen.astype(np.float64))[:, None])
        if transition.terminated.any():
            return step + 1
        states = transition.states
    return None


@pytest.mark.parametrize(("kind", "ends", "steps"), [("continuous", (-1, 1), 65), ("discrete", (0, 2), 83)])
def test_the_fastest_possible_episodes_of_mountain_car_are_those_of_the_thesis(kind, ends, steps):
    world = MountainCar(kind)
    assert fastest_bang_bang(world, ends) == steps
    farthest = farthest_positions(world, steps)
    assert max(farthest[:-1]) < world.goal - 0.001
    assert farthest[-1] >= world.goal


def test_no_car_passes_the_positions_that_none_can_pass():
    """20,000 cars that are pushed one way and the other at random."""
    world, width, generator = MountainCar(), 2e-4, torch.Generator().manual_seed(0)
    x = torch.rand(20_000, dtype=torch.float64, generator=generator) * 0.2 - 0.6
    states = torch.stack([x, torch.zeros_like(x)], dim=1)
    push = torch.ones(20_000, 1, dtype=torch.float64)
    for position in farthest_positions(world, 64, width):
        turned = torch.rand(20_000, 1, generator=generator) < 0.05
        push = torch.where(turned, -push, push)
        states = world.step(states, push).states
        assert states[:, 0].max() <= position
