"""The native engine and the pure-torch engine do the same arithmetic: a few updates from a state of training, and whole runs."""

import numpy as np
import pytest
import torch

import agents
from agents import kernels
from agents.networks import PopulationMLP
from agents.optimizer import PopulationAdam
from agents.population import padded
from agents.registry import ALGORITHMS, ENVIRONMENTS, find_algorithm
from agents.replay import Batch
from agents.rng import RandomStream
from agents.training import _make

PAIRS = [
    (algorithm, environment)
    for algorithm in ALGORITHMS
    for environment in ENVIRONMENTS
    if ENVIRONMENTS[environment].actions in ALGORITHMS[algorithm].actions
]
P, VISITED_STEPS, UPDATES = 3, 300, 5
COLUMNS = ("states", "actions", "states_actions", "rewards", "continues", "next_states")


def parts(thing, kind, path=""):
    """Path → every object of a kind within an object of this package."""
    if isinstance(thing, kind):
        return {path: thing}
    if not type(thing).__module__.startswith("agents."):
        return {}
    found = {}
    for name, part in vars(thing).items():
        found |= parts(part, kind, f"{path}.{name}")
    return found


def lockstep(algorithm, environment, hidden_layers):
    """Agents with critic step-sizes of 1e-2 to 1e-4, and a tenth of these for the actor.

    Where two actions are of equal value but for the last bit, engines may choose different elites, and the actor's step-size is
    what they then differ by.
    """
    cls, shared = ALGORITHMS[algorithm].hypers, {"actor_step_size_scale": 0.1, "hidden_layers": hidden_layers}
    hypers = [cls(critic_step_size=10.0 ** -(2 + p), **shared) for p in range(P)]
    population = padded(hypers, [3, 1, 4], torch.device("cpu"))
    known = ENVIRONMENTS[environment]
    return _make(find_algorithm(algorithm), known, known.make(P), population, 1000, 60, 0.99)


def take_over(ours, theirs):
    """Give the torch engine's agents the networks and moments of the native engine's."""
    networks, optimizers = parts(ours, PopulationMLP), parts(ours, PopulationAdam)
    for path, twin in parts(theirs, PopulationMLP).items():
        twin.parameters.copy_(networks[path].parameters)
    for path, twin in parts(theirs, PopulationAdam).items():
        twin.first_moment.copy_(optimizers[path].first_moment)
        twin.second_moment.copy_(optimizers[path].second_moment)
        twin._powers.copy_(twin._decays ** optimizers[path].num_steps)


@pytest.mark.skipif(kernels.report().engine == "torch", reason="no native kernels here")
@pytest.mark.parametrize("hidden_layers", [(64, 64), (64, 64, 64)], ids=["two", "three"])
@pytest.mark.parametrize(("algorithm", "environment"), PAIRS)
def test_five_updates_from_states_visited_in_training_are_the_same(algorithm, environment, hidden_layers):
    with torch.no_grad():
        with kernels.using("native"):
            native = lockstep(algorithm, environment, hidden_layers)
        for _ in range(VISITED_STEPS):
            native.run()
        with kernels.using("torch"):
            oracle = lockstep(algorithm, environment, hidden_layers).agents
            words = RandomStream(native.stream.seeds)
        take_over(native.agents, oracle)
        before = {path: x.parameters.clone() for path, x in parts(native.agents, PopulationMLP).items()}
        for step in range(VISITED_STEPS + 1, VISITED_STEPS + 1 + UPDATES):
            batch = native.replay.sample(native.stream, step, 32)
            expected = oracle.update(Batch(**{name: getattr(batch, name).clone() for name in COLUMNS}), step)
            torch.testing.assert_close(native.agents.update(batch, step), expected, rtol=1e-3, atol=0)
            assert torch.equal(words.integers(3, step, 32, VISITED_STEPS), native.stream.integers(3, step, 32, VISITED_STEPS))
    twins = parts(oracle, PopulationMLP)
    for path, network in parts(native.agents, PopulationMLP).items():
        for (weights, biases), (their_weights, their_biases) in zip(network.layers, twins[path].layers, strict=True):
            ours, theirs = (
                torch.cat([w.flatten(1), b.flatten(1)], 1) for w, b in ((weights, biases), (their_weights, their_biases))
            )
            assert ((ours - theirs).norm(dim=1) <= 1e-5 * theirs.norm(dim=1)).all(), path
        moved = (network.parameters - before[path]).norm(dim=1)
        assert (moved > 1e-5 * network.parameters.norm(dim=1)).any(), path  # there was something to compare


@pytest.mark.statistical
@pytest.mark.skipif(kernels.report().engine == "torch", reason="no native kernels here")
@pytest.mark.parametrize(
    ("algorithm", "environment", "step_size", "scale", "entropy_scale", "steps"),
    [
        ("GreedyAC", "Pendulum-CA", 1e-3, 1.0, 0.1, 30_000),
        ("SAC", "Pendulum-CA", 1e-2, 0.1, 0.1, 20_000),
        ("GreedyAC", "Pendulum-DA", 1e-3, 1.0, 0.1, 25_000),
        ("VanillaAC", "Pendulum-DA", 1e-3, 1.0, 0.1, 25_000),
    ],
)
def test_whole_learning_curves_of_the_two_engines_are_statistically_the_same(
    algorithm, environment, step_size, scale, entropy_scale, steps
):
    """24 seeds each; the permutation test of the largest difference between the mean curves, in standard errors, over blocks."""
    seeds, known = range(24), ALGORITHMS[algorithm].hypers.table
    hypers = {"critic_step_size": step_size, "actor_step_size_scale": scale, "entropy_scale": entropy_scale}
    made = ALGORITHMS[algorithm].hypers(**{name: value for name, value in hypers.items() if name in known})
    curves = []
    for engine in ("native", "torch"):
        with kernels.using(engine):
            records = agents.train(algorithm, environment, [made] * len(seeds), seeds, steps=steps)
        curves.append(records.episodic_return.reshape(len(seeds), -1, 5).mean(2))  # blocks of five episodes
    curves = np.concatenate(curves)

    def distance(first, second):
        spread = np.sqrt(first.var(0, ddof=1) / len(first) + second.var(0, ddof=1) / len(second))
        return np.abs(first.mean(0) - second.mean(0)).max(initial=0, where=spread > 0) / spread.max()

    def largest(order):
        return distance(curves[order[: len(seeds)]], curves[order[len(seeds) :]])

    rng = np.random.default_rng(0)
    observed = largest(np.arange(len(curves)))
    null = [largest(rng.permutation(len(curves))) for _ in range(2000)]
    p = (1 + sum(value >= observed for value in null)) / (1 + len(null))
    means = [curves[: len(seeds)].mean(0), curves[len(seeds) :].mean(0)]
    print(f"\n{algorithm} {environment}: native {np.round(means[0])}, torch {np.round(means[1])}, p = {p:.3f}")
    assert p > 0.01
