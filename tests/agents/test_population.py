"""Laws of a population, bit for bit on the CPU: who is trained beside whom changes nothing."""

import numpy as np
import pytest
import torch

import agents
from agents import kernels
from agents.hypers import GreedyACHypers, SACHypers
from agents.networks import PopulationMLP
from agents.population import Population
from agents.registry import ALGORITHMS, ENVIRONMENTS, AlgorithmLookupError

STEPS = 150
COLUMNS = ("first_step", "length", "episodic_return", "ending")


def settings(algorithm, count, **shared):
    cls = ALGORITHMS[algorithm].hypers
    own = {"entropy_scale": lambda i: 0.1 * (i % 5), "exploration_scale": lambda i: 0.1 * (i % 3)}
    return [
        cls(
            critic_step_size=10.0 ** -(2 + i % 3),
            actor_step_size_scale=0.5 + i % 4,
            **shared,
            **{name: value(i) for name, value in own.items() if name in cls.table},
        )
        for i in range(count)
    ]


PAIRS = [
    (algorithm, environment)
    for algorithm in ALGORITHMS
    for environment in ENVIRONMENTS
    if ENVIRONMENTS[environment].actions in ALGORITHMS[algorithm].actions
]
ONE_OF_EACH_KIND = [pair for pair in PAIRS if pair[1].startswith("Pendulum")]


@pytest.fixture(params=["auto", "torch"])
def engine(request):
    """The engine that this machine trains with, and the one in pure torch."""
    with kernels.using(request.param):
        yield


def train(algorithm, environment, hypers, seeds, steps=STEPS):
    return agents.train(algorithm, environment, hypers, seeds, steps=steps, cutoff=20)


def episodes(records, agent):
    return np.stack([getattr(records, name)[records.agent == agent].astype(np.float64) for name in COLUMNS])


def assert_same_agent(first, first_index, second, second_index):
    np.testing.assert_array_equal(episodes(first, first_index), episodes(second, second_index))


@pytest.mark.parametrize(("algorithm", "environment"), PAIRS)
def test_an_agent_alone_equals_the_same_agent_in_a_crowd(algorithm, environment):
    hypers, seeds = settings(algorithm, 7), [3, 1, 4, 1, 5, 9, 2]
    crowd = train(algorithm, environment, hypers, seeds)
    for index in (0, 3, 6):
        assert_same_agent(train(algorithm, environment, [hypers[index]], [seeds[index]]), 0, crowd, index)
    pair = train(algorithm, environment, [hypers[5], hypers[2]], [seeds[5], seeds[2]])
    assert_same_agent(pair, 0, crowd, 5)
    assert_same_agent(pair, 1, crowd, 2)


def networks_of(thing):
    """Every population network within an algorithm, found by looking into it."""
    if isinstance(thing, PopulationMLP):
        yield thing
    elif type(thing).__module__.startswith("agents."):
        for part in vars(thing).values():
            yield from networks_of(part)


UNEVEN, WIDE = {"hidden_layers": (10, 33, 7), "batch_size": 5}, {"hidden_layers": (64, 64, 64)}


@pytest.mark.parametrize(
    ("engine", "shared"),
    [
        ("auto", {}),
        ("auto", UNEVEN),
        ("auto", WIDE),
        ("torch", {}),
        pytest.param("torch", UNEVEN, marks=pytest.mark.slow),
        pytest.param("torch", WIDE, marks=pytest.mark.slow),
    ],
    indirect=["engine"],
)
@pytest.mark.parametrize(("algorithm", "environment"), ONE_OF_EACH_KIND)
def test_every_parameter_of_an_agent_is_the_same_alone_and_in_a_crowd(algorithm, environment, shared, monkeypatch, engine):
    """Returns could hide a difference in the last bit; parameters after 100 updates cannot."""
    original, caught = ALGORITHMS[algorithm].load(), []

    def spy(*arguments):
        caught.append(original(*arguments))
        return caught[-1]

    monkeypatch.setattr(type(ALGORITHMS[algorithm]), "load", lambda self: spy)

    def parameters(hypers, seeds):
        train(algorithm, environment, hypers, seeds)
        networks = list(networks_of(caught.pop()))
        assert len(networks) >= 3
        return torch.cat([network.parameters.reshape(max(2, len(hypers)), -1) for network in networks], 1)

    for count in (2, 5, 33):
        hypers, seeds = settings(algorithm, count, **shared), list(range(count))
        crowd = parameters(hypers, seeds)
        for index in {0, count // 2, count - 1}:
            assert torch.equal(parameters([hypers[index]], [seeds[index]])[0], crowd[index])


@pytest.mark.parametrize(("algorithm", "environment"), ONE_OF_EACH_KIND)
def test_two_seeds_differ_and_the_same_seed_repeats(algorithm, environment):
    hypers = settings(algorithm, 1) * 3
    records = train(algorithm, environment, hypers, [0, 1, 0])
    assert not np.array_equal(episodes(records, 0)[2], episodes(records, 1)[2])
    assert_same_agent(records, 0, records, 2)


@pytest.mark.parametrize(("algorithm", "environment"), ONE_OF_EACH_KIND)
def test_different_seeds_differ_in_weights_actions_and_minibatches(algorithm, environment, monkeypatch):
    original, caught, batches, actions = ALGORITHMS[algorithm].load(), [], [], []

    class Spy(original):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            caught.extend(network.parameters.clone() for network in networks_of(self))

        def act(self, observations, step):
            actions.append(super().act(observations, step))
            return actions[-1]

        def update(self, batch, step):
            batches.append(batch.rewards.clone())
            return super().update(batch, step)

    monkeypatch.setattr(type(ALGORITHMS[algorithm]), "load", lambda self: Spy)
    train(algorithm, environment, settings(algorithm, 1) * 2, [0, 1], steps=40)
    for parameters in caught:
        first, second = parameters.reshape(2, -1)
        assert not torch.equal(first, second)
    assert not torch.equal(torch.stack(actions)[:, 0], torch.stack(actions)[:, 1])
    assert not torch.equal(torch.stack(batches)[:, 0], torch.stack(batches)[:, 1])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_three_hidden_layers_train_too(algorithm):
    hypers = settings(algorithm, 2, hidden_layers=(64, 64, 64))
    assert np.isfinite(train(algorithm, "MountainCar-CA", hypers, [0, 1], steps=50).episodic_return).all()


@pytest.fixture
def trained(monkeypatch):
    """Train, and return the records and every parameter of the agents [P, n] at the end."""

    def train_and_look(algorithm, environment, hypers, seeds):
        original, caught = type(ALGORITHMS[algorithm]).load, []

        def spy(entry):
            cls = original(entry)
            return lambda *arguments: caught.append(cls(*arguments)) or caught[-1]

        with monkeypatch.context() as patch:
            patch.setattr(type(ALGORITHMS[algorithm]), "load", spy)
            records = train(algorithm, environment, hypers, seeds)
        networks = networks_of(caught[-1])
        return records, torch.cat([network.parameters.reshape(max(2, len(hypers)), -1) for network in networks], 1)

    return train_and_look


# A critic that overshoots, and an actor that does while its critic stays finite.
WAYS_TO_DIVERGE = [{"critic_step_size": 1e30}, {"critic_step_size": 1e-3, "actor_step_size_scale": 1e38}]


@pytest.mark.parametrize("bad", WAYS_TO_DIVERGE, ids=["critic", "actor"])
@pytest.mark.parametrize(("algorithm", "environment"), ONE_OF_EACH_KIND)
def test_an_agent_that_diverges_is_frozen_and_marked_and_its_neighbours_do_not_notice(
    algorithm, environment, bad, trained, monkeypatch, engine
):
    given, cls = [], type(ENVIRONMENTS[environment].make(3))
    step = cls.step

    def spy(self, states, actions):
        given.append(actions.clone())
        return step(self, states, actions)

    hypers = ALGORITHMS[algorithm].hypers
    good = hypers(critic_step_size=1e-3)
    with monkeypatch.context() as patch:
        patch.setattr(cls, "step", spy)
        records, parameters = trained(algorithm, environment, [good, hypers(**bad), good], [0, 1, 2])
    assert not parameters[1].isfinite().all()
    assert parameters[[0, 2]].isfinite().all()
    diverged_at = int(records.diverged_at[1])
    assert records.diverged_at[0] == records.diverged_at[2] == 0
    assert 32 <= diverged_at <= 60
    actions = torch.stack(given)
    assert actions.isfinite().all()
    assert not actions[diverged_at:, 1].any()
    assert actions[diverged_at:, 0].any()
    returns = records.episodic_return[records.agent == 1]
    first_bad = (diverged_at - 1) // 20
    assert np.isfinite(returns[:first_bad]).all() and np.isnan(returns[first_bad:]).all()
    healthy, healthy_parameters = trained(algorithm, environment, [good, good], [0, 2])
    assert_same_agent(records, 0, healthy, 0)
    assert_same_agent(records, 2, healthy, 1)
    assert torch.equal(parameters[[0, 2]], healthy_parameters)


def test_agents_whose_tensor_programs_differ_are_refused():
    hypers = (SACHypers(batch_size=32), SACHypers(batch_size=64))
    with pytest.raises(ValueError, match="equal shared hyperparameters"):
        Population(hypers, (0, 1), torch.device("cpu"))


def test_what_cannot_be_trained_is_refused():
    with pytest.raises(ValueError, match="DDPG acts in continuous action spaces only; Pendulum-DA is discrete"):
        train("DDPG", "Pendulum-DA", settings("DDPG", 1), [0])
    with pytest.raises(AlgorithmLookupError, match='"TRPO": unknown agent'):
        train("TRPO", "Pendulum-DA", settings("DDPG", 1), [0])
    with pytest.raises(ValueError, match="SAC takes SACHypers"):
        train("SAC", "Pendulum-CA", [GreedyACHypers()], [0])
    with pytest.raises(ValueError, match="steps = 0"):
        train("SAC", "Pendulum-CA", [SACHypers()], [0], steps=0)
    with pytest.raises(ValueError, match="2 hyperparameter settings for 3 seeds"):
        train("SAC", "Pendulum-CA", [SACHypers()] * 2, [0, 1, 2])


@pytest.mark.parametrize("before", [True, False])
def test_training_leaves_the_treatment_of_denormal_numbers_as_it_was(before):
    torch.set_flush_denormal(before)
    try:
        train("SAC", "Pendulum-CA", [SACHypers()], [0], steps=2)
        assert bool(torch.tensor(1e-40) * 1 == 0) == before
    finally:
        torch.set_flush_denormal(False)


def test_lengths_sum_to_the_steps_and_the_cutoff_truncates():
    records = train("SAC", "Pendulum-CA", settings("SAC", 2), [0, 1], steps=110)
    for agent in (0, 1):
        lengths = records.length[records.agent == agent]
        assert lengths.tolist() == [20] * 5 + [10]
    assert records.ending.tolist() == ([1] * 5 + [2]) * 2


def test_training_reports_every_step():
    steps = []
    agents.train("SAC", "Pendulum-CA", settings("SAC", 1), [0], steps=5, on_step=steps.append)
    assert steps == [1, 2, 3, 4, 5]
