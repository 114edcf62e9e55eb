"""Deterministic evaluation episodes beside the learning."""

import math

import numpy as np
import pytest
import torch

import agents
from agents.evaluation import Evaluation
from agents.hypers import ActorCriticHypers
from agents.registry import ALGORITHMS, find_environment

PAIRS = [
    (algorithm, environment)
    for algorithm in ALGORITHMS
    for environment in ("Pendulum-CA", "Pendulum-DA", "Pendulum-v1", "CartPole-v1")
    if find_environment(environment).actions in ALGORITHMS[algorithm].actions
]


class FullTorque:
    """Learns nothing; explores with torque −2, is evaluated with torque 2."""

    hypers, actions = ActorCriticHypers, ("continuous",)

    def __init__(self, population, task, stream):
        self.population = len(population)

    def act(self, observations, step):
        return torch.full((self.population, 1), -2.0)

    def act_deterministically(self, observations):
        return torch.full((self.population, 1), 2.0)

    def update(self, batch, step):
        return torch.zeros(self.population)


class Unable(FullTorque):
    act_deterministically = property()


def test_returns_are_those_of_the_deterministic_policy():
    records = agents.train(
        f"{__name__}:FullTorque",
        "Pendulum-CA",
        [ActorCriticHypers()] * 2,
        [0, 1],
        steps=25,
        cutoff=30,
        evaluation=Evaluation(10, 2),
    )
    theta, omega, expected = -math.pi, 0.0, 0.0
    for _ in range(30):
        omega += (15 * math.sin(theta) + 3 * 2) * 0.05
        theta = (theta + 0.05 * omega + math.pi) % (2 * math.pi) - math.pi
        omega = min(max(omega, -8), 8)
        expected += math.cos(theta)
    e = records.evaluations
    assert e.agent.tolist() == [0] * 4 + [1] * 4
    assert e.step.tolist() == [10, 10, 20, 20] * 2
    assert e.episode.tolist() == [0, 1] * 4
    assert e.length.tolist() == [30] * 8
    assert e.ending.tolist() == [1] * 8
    np.testing.assert_allclose(e.episodic_return, expected, rtol=1e-6)


@pytest.mark.parametrize(("algorithm", "environment"), PAIRS)
def test_learning_does_not_change_by_being_evaluated_and_an_agent_is_evaluated_alone_as_in_a_crowd(algorithm, environment):
    hypers = [ALGORITHMS[algorithm].hypers(critic_step_size=step_size) for step_size in (1e-2, 1e-3, 1e-4)]

    def train(which, evaluation):
        chosen = [hypers[i] for i in which]
        return agents.train(algorithm, environment, chosen, list(which), steps=90, cutoff=20, evaluation=evaluation)

    crowd, without = train(range(3), Evaluation(40, 2)), train(range(3), None)
    np.testing.assert_array_equal(crowd.episodic_return, without.episodic_return)
    assert without.evaluations is None
    alone = train([1], Evaluation(40, 2)).evaluations
    np.testing.assert_array_equal(alone.episodic_return, crowd.evaluations.episodic_return[crowd.evaluations.agent == 1])
    assert set(alone.step.tolist()) == {40, 80}


def test_an_agent_that_has_diverged_is_evaluated_as_nan():
    hypers = [ALGORITHMS["SAC"].hypers(critic_step_size=x) for x in (1e-3, 1e30)]
    e = agents.train("SAC", "Pendulum-CA", hypers, [0, 1], steps=80, cutoff=20, evaluation=Evaluation(80, 1)).evaluations
    assert np.isfinite(e.episodic_return).tolist() == [True, False]


def test_evaluating_never_or_with_no_episodes_is_refused():
    for every, episodes in ((0, 1), (1, 0)):
        with pytest.raises(ValueError, match="must be at least 1"):
            Evaluation(every, episodes)


def test_an_algorithm_that_cannot_act_deterministically_is_refused():
    with pytest.raises(ValueError, match="cannot be evaluated: it has no act_deterministically"):
        agents.train(f"{__name__}:Unable", "Pendulum-CA", [ActorCriticHypers()], [0], steps=5, evaluation=Evaluation(5, 1))


class WithTheVelocity(FullTorque):
    """Drives Mountain Car to its goal: always pushes the way the car is going."""

    def act_deterministically(self, observations):
        return torch.where(observations[:, 1:] >= 0, 1.0, -1.0)


def test_an_episode_that_terminates_stops_counting_and_the_others_go_on():
    name, seeds = f"{__name__}:WithTheVelocity", range(8)
    e = agents.train(
        name, "MountainCar-CA", [ActorCriticHypers()] * 8, seeds, steps=5, cutoff=300, evaluation=Evaluation(5, 1)
    ).evaluations
    assert e.ending.tolist() == [0] * 8
    assert len(set(e.length.tolist())) > 1
    assert e.length.min() >= 65
    np.testing.assert_array_equal(e.episodic_return, -e.length)
