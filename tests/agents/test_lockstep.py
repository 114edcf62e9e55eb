"""A lock-step can be captured as a CUDA graph: shown without a GPU, by recording it, and on tensors that have no values."""

import pytest
import torch
from recorded_graph import RecordedGraph, tensors

from agents import kernels
from agents.hypers import DDPGHypers, SACHypers
from agents.networks import PopulationMLP
from agents.optimizer import PopulationAdam
from agents.population import padded
from agents.registry import ALGORITHMS, ENVIRONMENTS, find_algorithm
from agents.rng import Purpose
from agents.training import _make

PAIRS = [
    (algorithm, environment)
    for algorithm in ALGORITHMS
    for environment in ("Pendulum-CA", "Pendulum-DA", "Acrobot-CA", "MountainCar-DA")
    if ENVIRONMENTS[environment].actions in ALGORITHMS[algorithm].actions
]
SWITCHES = {
    "DDPG": DDPGHypers(exploration_noise="ornstein-uhlenbeck", batch_size=8, replay_capacity=20, hidden_layers=(8,)),
    "SAC": SACHypers(entropy_tuning="automatic", batch_size=8, replay_capacity=20, hidden_layers=(8,)),
}
SMALL = {"batch_size": 8, "replay_capacity": 20, "hidden_layers": (8,)}


def lockstep(algorithm, environment, hypers, device="cpu", cutoff=7):
    population = padded([hypers] * 3, [4, 5, 6], torch.device(device))
    known = ENVIRONMENTS[environment]
    return _make(find_algorithm(algorithm), known, known.make(3), population, 1000, cutoff, 0.99)


def lasting_tensors(thing, seen=None):
    """Every tensor that an object of this package holds, by looking into it."""
    seen = set() if seen is None else seen
    if isinstance(thing, torch.Tensor):
        yield thing
    elif isinstance(thing, dict):
        for part in thing.values():
            yield from lasting_tensors(part, seen)
    elif isinstance(thing, list | tuple):
        for part in thing:
            yield from lasting_tensors(part, seen)
    elif type(thing).__module__.startswith("agents.") and id(thing) not in seen:
        seen.add(id(thing))
        for part in vars(thing).values():
            yield from lasting_tensors(part, seen)


def what_was_learned(run):
    networks = [x for x in (*vars(run.agents).values(), *vars(run.agents.critic).values()) if isinstance(x, PopulationMLP)]
    optimizers = [x for x in vars(run.agents.critic).values() if isinstance(x, PopulationAdam)]
    actor = run.agents.actor
    networks.append(actor if isinstance(actor, PopulationMLP) else actor.network)
    columns = [run.recorder._rewards, run.recorder._endings, run.replay.rows, run.observations, run.elapsed, run.healthy]
    return [*(x.parameters for x in networks), *(x.second_moment for x in optimizers), *columns]


def check_replay(algorithm, environment, hypers):
    with kernels.using("torch"), torch.no_grad():
        one_by_one, replayed = lockstep(algorithm, environment, hypers), lockstep(algorithm, environment, hypers)
        for _ in range(150):
            one_by_one.run()
        for _ in range(10):
            replayed.run()
        graph = RecordedGraph()
        with graph:
            replayed.run()
        for _ in range(139):
            replayed.clock.number += 1
            replayed.stream.prepare(replayed.clock.number)
            graph.replay()
            replayed.recorder.count()
    assert torch.equal(one_by_one.clock.tensor, replayed.clock.tensor)
    for expected, found in zip(what_was_learned(one_by_one), what_was_learned(replayed), strict=True):
        assert torch.equal(expected, found)
    assert (one_by_one.recorder._endings[:150] > 0).any()


@pytest.mark.parametrize(("algorithm", "environment"), PAIRS)
def test_a_step_that_is_recorded_once_and_replayed_does_what_steps_one_by_one_do(algorithm, environment):
    check_replay(algorithm, environment, ALGORITHMS[algorithm].hypers(**SMALL))


@pytest.mark.parametrize("algorithm", SWITCHES)
def test_so_does_one_with_state_of_its_own_beside_the_networks(algorithm):
    check_replay(algorithm, "Pendulum-CA", SWITCHES[algorithm])


class NoHost(RecordedGraph):
    """Fails where an operation touches memory of the host."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = super().__torch_dispatch__(function, types, args, kwargs)
        assert not [x for x in tensors((args, kwargs, result)) if x.device.type == "cpu"], function
        return result


@pytest.mark.parametrize(("algorithm", "environment"), PAIRS)
def test_a_learning_step_neither_waits_for_the_device_nor_copies_from_the_host(algorithm, environment, monkeypatch):
    """On the device "meta" tensors have no values: whatever reads one in Python raises."""
    with torch.no_grad():
        run = lockstep(algorithm, environment, ALGORITHMS[algorithm].hypers(batch_size=4), device="meta")
        for _ in range(5):
            run.run()
        for maker in ((torch, "tensor"), (torch, "as_tensor"), (torch, "from_numpy"), (torch.Tensor, "new_tensor")):
            monkeypatch.setattr(*maker, None, raising=False)  # they would copy numbers of Python's
        with NoHost() as graph:
            run.run()
    assert run.clock.number == 6
    assert len(graph.calls) > 100


def test_every_built_in_algorithm_can_be_captured_and_an_unknown_one_is_not():
    assert all(getattr(entry.load(), "capturable", False) for entry in ALGORITHMS.values())
    with kernels.using("torch"):
        assert lockstep("SAC", "Pendulum-CA", SACHypers()).clock.tensor is not None
    with kernels.using("torch"), pytest.MonkeyPatch.context() as patch:
        patch.setattr(ALGORITHMS["SAC"].load(), "capturable", False)
        assert lockstep("SAC", "Pendulum-CA", SACHypers()).clock.tensor is None


def test_a_subclass_is_captured_only_if_it_says_so_itself(monkeypatch):
    class Scheduled(ALGORITHMS["SAC"].load()):
        def update(self, batch, step):
            return super().update(batch, min(step, 1000))

    monkeypatch.setattr(type(ALGORITHMS["SAC"]), "load", lambda self: Scheduled)
    with kernels.using("torch"):
        assert lockstep("SAC", "Pendulum-CA", SACHypers()).clock.tensor is None


def test_numbers_that_are_drawn_once_are_not_drawn_for_every_step():
    with kernels.using("torch"), torch.no_grad():
        run = lockstep("SAC", "Pendulum-CA", SACHypers(**SMALL))
        for _ in range(20):
            run.run()
    purposes = {purpose for _, purpose, _ in run.stream._followed}
    assert purposes == {Purpose.START_STATE, Purpose.ACTION, Purpose.MINIBATCH, Purpose.NEXT_ACTION, Purpose.POLICY_UPDATE}


def test_the_native_engine_counts_on_the_host():
    with kernels.using("auto"):
        native = kernels.library("cpu") is not None
        assert (lockstep("SAC", "Pendulum-CA", SACHypers()).clock.tensor is None) == native
