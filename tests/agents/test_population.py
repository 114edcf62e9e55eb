"""Laws of a population, bit for bit on the CPU: who is trained beside whom changes nothing."""

import numpy as np
import pytest
import torch

import agents
from agents.hypers import GreedyACHypers, SACHypers
from agents.population import Population
from agents.registry import ALGORITHMS, ENVIRONMENTS

STEPS = 150
COLUMNS = ("first_step", "length", "episodic_return", "ending")


def settings(algorithm, count, **shared):
    cls = ALGORITHMS[algorithm].hypers
    return [
        cls(
            critic_step_size=10.0 ** -(2 + i % 3),
            actor_step_size_scale=0.5 + i % 4,
            entropy_scale=0.1 * (i % 5),
            **shared,
        )
        for i in range(count)
    ]


def train(algorithm, environment, hypers, seeds, steps=STEPS):
    return agents.train(algorithm, environment, hypers, seeds, steps=steps, cutoff=20)


def episodes(records, agent):
    return np.stack([getattr(records, name)[records.agent == agent].astype(np.float64) for name in COLUMNS])


def assert_same_agent(first, first_index, second, second_index):
    np.testing.assert_array_equal(episodes(first, first_index), episodes(second, second_index))


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_agent_alone_equals_the_same_agent_in_a_crowd(algorithm, environment):
    hypers, seeds = settings(algorithm, 7), [3, 1, 4, 1, 5, 9, 2]
    crowd = train(algorithm, environment, hypers, seeds)
    for index in (0, 3, 6):
        assert_same_agent(train(algorithm, environment, [hypers[index]], [seeds[index]]), 0, crowd, index)
    pair = train(algorithm, environment, [hypers[5], hypers[2]], [seeds[5], seeds[2]])
    assert_same_agent(pair, 0, crowd, 5)
    assert_same_agent(pair, 1, crowd, 2)


@pytest.mark.parametrize("shared", [{}, {"hidden_layers": (10, 33, 7), "batch_size": 5}, {"hidden_layers": (64, 64, 64)}])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_parameter_of_an_agent_is_the_same_alone_and_in_a_crowd(algorithm, shared):
    """Returns could hide a difference in the last bit; parameters after 100 updates cannot."""

    def parameters(hypers, seeds):
        caught = []
        cls = ALGORITHMS[algorithm].load()

        class Spy(cls):
            def __init__(self, *arguments):
                super().__init__(*arguments)
                caught.append(self)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(type(ALGORITHMS[algorithm]), "load", lambda self: Spy)
            train(algorithm, "Pendulum-CA", hypers, seeds)
        networks = [
            network for network in vars(caught[0]).values() if hasattr(network, "parameters") and hasattr(network, "widths")
        ]
        rows = [network.parameters.view(len(hypers) if len(hypers) > 1 else 2, -1) for network in networks]
        return torch.cat(rows, 1)

    for count in (2, 5, 33):
        hypers, seeds = settings(algorithm, count, **shared), list(range(count))
        crowd = parameters(hypers, seeds)
        for index in {0, count // 2, count - 1}:
            assert torch.equal(parameters([hypers[index]], [seeds[index]])[0], crowd[index])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_two_seeds_differ_and_the_same_seed_repeats(algorithm):
    hypers = settings(algorithm, 1) * 3
    records = train(algorithm, "Pendulum-CA", hypers, [0, 1, 0])
    assert not np.array_equal(episodes(records, 0)[2], episodes(records, 1)[2])
    assert_same_agent(records, 0, records, 2)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_three_hidden_layers_train_too(algorithm):
    hypers = settings(algorithm, 2, hidden_layers=(64, 64, 64))
    assert np.isfinite(train(algorithm, "MountainCar-CA", hypers, [0, 1], steps=50).episodic_return).all()


@pytest.mark.parametrize(("algorithm", "cls"), [("GreedyAC", GreedyACHypers), ("SAC", SACHypers)])
def test_an_agent_that_diverges_is_marked_and_its_neighbours_do_not_notice(algorithm, cls):
    good, bad = cls(critic_step_size=1e-3), cls(critic_step_size=1e30)
    records = train(algorithm, "MountainCar-CA", [good, bad, good], [0, 1, 2])
    assert records.diverged_at[0] == records.diverged_at[2] == 0
    assert 32 <= records.diverged_at[1] <= 60
    returns = records.episodic_return[records.agent == 1]
    first_bad = int((records.diverged_at[1] - 1) // 20)
    assert np.isfinite(returns[:first_bad]).all() and np.isnan(returns[first_bad:]).all()
    healthy = train(algorithm, "MountainCar-CA", [good, good], [0, 2])
    assert_same_agent(records, 0, healthy, 0)
    assert_same_agent(records, 2, healthy, 1)


def test_agents_whose_tensor_programs_differ_are_refused():
    hypers = (SACHypers(batch_size=32), SACHypers(batch_size=64))
    with pytest.raises(ValueError, match="equal shared hyperparameters"):
        Population(hypers, (0, 1), torch.device("cpu"))


def test_what_cannot_be_trained_is_refused():
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
