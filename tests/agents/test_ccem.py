"""Theorem 4.3.1 on small tabular problems: the percentile-greedy policy is at least as good in all states."""

import numpy as np
import pytest
import torch

from agents.algorithms.ccem import percentile_greedy

STATES, ACTIONS, DISCOUNT = 6, 7, 0.9


def random_problem(seed):
    """Transition probabilities [S, A, S], rewards [S, A], a policy [S, A]."""
    generator = np.random.default_rng(seed)
    transitions = generator.dirichlet(np.full(STATES, 0.3), (STATES, ACTIONS))
    return transitions, generator.normal(size=(STATES, ACTIONS)), generator.dirichlet(np.full(ACTIONS, 0.7), STATES)


def evaluate(transitions, rewards, policy):
    """State values [S] and action values [S, A], by solving the Bellman equation."""
    of_states = np.einsum("sa,sat->st", policy, transitions)
    values = np.linalg.solve(np.eye(STATES) - DISCOUNT * of_states, (policy * rewards).sum(1))
    return values, rewards + DISCOUNT * transitions @ values


@pytest.mark.parametrize("fraction", [0.05, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("seed", range(20))
def test_the_percentile_greedy_policy_is_at_least_as_good_in_every_state(seed, fraction):
    transitions, rewards, policy = random_problem(seed)
    before, action_values = evaluate(transitions, rewards, policy)
    improved = percentile_greedy(torch.tensor(policy), torch.tensor(action_values), fraction).numpy()
    np.testing.assert_allclose(improved.sum(1), 1)
    assert (improved <= policy / fraction + 1e-12).all()
    after, _ = evaluate(transitions, rewards, improved)
    assert (after >= before - 1e-9).all()
    if fraction < 1:
        assert (after > before + 1e-6).any()
    else:
        np.testing.assert_allclose(improved, policy)


def test_repeating_it_reaches_the_optimal_policy():
    transitions, rewards, policy = random_problem(0)
    optimal = np.zeros(STATES)
    for _ in range(1000):  # value iteration
        optimal = (rewards + DISCOUNT * transitions @ optimal).max(1)
    for _ in range(200):
        values, action_values = evaluate(transitions, rewards, policy)
        policy = percentile_greedy(torch.tensor(policy), torch.tensor(action_values), 0.5).numpy()
    np.testing.assert_allclose(values, optimal, atol=1e-6)


def test_the_action_at_the_threshold_keeps_the_part_that_is_left():
    policy, values = torch.tensor([0.2, 0.3, 0.5]), torch.tensor([1.0, 3.0, 2.0])
    torch.testing.assert_close(percentile_greedy(policy, values, 0.4), torch.tensor([0.0, 0.75, 0.25]))


@pytest.mark.parametrize("fraction", [0.0, -0.1, 1.1])
def test_a_fraction_outside_its_range_is_refused(fraction):
    with pytest.raises(ValueError, match="elite fraction"):
        percentile_greedy(torch.ones(2) / 2, torch.ones(2), fraction)
