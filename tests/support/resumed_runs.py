"""Small populations that are saved on their way, and new ones that go on from there."""

import numpy as np
import torch

from agents.networks import PopulationMLP
from agents.registry import ALGORITHMS, ENVIRONMENTS, find_algorithm
from agents.training import Run

STEPS, CUTOFF, BATCH = 90, 21, 24
SMALL = {"batch_size": BATCH, "replay_capacity": 40, "hidden_layers": (8,)}
# the first step; around an episode's end, before learning; the first update; a replay buffer that has wrapped around; the end
PLACES = (1, CUTOFF - 1, CUTOFF, CUTOFF + 1, BATCH, 47, STEPS - 1)
PAIRS = [
    (algorithm, environment)
    for algorithm in ALGORITHMS
    for environment in ("MountainCar-CA", "Pendulum-DA")
    if ENVIRONMENTS[environment].actions in ALGORITHMS[algorithm].actions
]
COLUMNS = ("agent", "episode", "first_step", "length", "episodic_return", "ending", "diverged_at")


def population(algorithm, count=3, **changes):
    cls = find_algorithm(algorithm).hypers
    rest = {"num_action_samples": 4, "elite_fraction": 0.5}
    rest = {name: value for name, value in rest.items() if name in cls.table}
    return [cls(critic_step_size=10.0 ** -(1 + i), **SMALL, **rest, **changes) for i in range(count)]


def make(algorithm, environment, hypers=None, **arguments):
    hypers = population(algorithm) if hypers is None else hypers
    return Run(algorithm, environment, hypers, [3, 1, 4][: len(hypers)], **{"steps": STEPS, "cutoff": CUTOFF, **arguments})


def copied(state):
    return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in state.items()}


def saved_at(run, places):
    """Train to the end, and return place → state there."""
    states = {}
    for place in places:
        run.advance(place - run.step)
        states[place] = copied(run.state())
    run.advance(run.steps - run.step)
    return states


def networks_of(thing):
    """Every population network within an algorithm, found by looking into it."""
    if isinstance(thing, PopulationMLP):
        yield thing
    elif type(thing).__module__.startswith("agents."):
        for part in vars(thing).values():
            yield from networks_of(part)


def assert_same(first, second):
    parameters = [[network.parameters for network in networks_of(run._lockstep.agents)] for run in (first, second)]
    assert all(torch.equal(a.nan_to_num(7.0), b.nan_to_num(7.0)) for a, b in zip(*parameters, strict=True))
    assert torch.equal(first._lockstep.observations, second._lockstep.observations)
    one, other = first.finish(), second.finish()
    for a, b in ((one, other), (one.evaluations, other.evaluations)):
        for name in COLUMNS if a is not None else ():
            np.testing.assert_array_equal(getattr(a, name, None), getattr(b, name, None), name)


def check_resumed(*arguments, places=PLACES, **keywords):
    uninterrupted = make(*arguments, **keywords)
    for place, state in saved_at(uninterrupted, places).items():
        resumed = make(*arguments, **keywords)
        resumed.restore(state)
        assert resumed.step == place
        resumed.advance(resumed.steps - place)
        assert_same(uninterrupted, resumed)
    return uninterrupted
