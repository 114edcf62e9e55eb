"""Tests of ranks over environments: printed examples, scipy, and enumeration of all permutations."""

from itertools import permutations, product

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.ranks import friedman, skillings_mack
from sweep.messages import UserError

NAN = np.nan
# Skillings and Mack 1981: assembly times of four methods in nine blocks; T = 15.493, p = 0.00144
ASSEMBLY = np.array(
    [
        [3.2, 3.1, 4.3, 3.5, 3.6, 4.5, NAN, 4.3, 3.5],
        [4.1, 3.9, 3.5, 3.6, 4.2, 4.7, 4.2, 4.6, NAN],
        [3.8, 3.4, 4.6, 3.9, 3.7, 3.7, 3.4, 4.4, 3.7],
        [4.2, 4.0, 4.8, 4.0, 3.9, NAN, NAN, 4.9, 3.9],
    ]
).T
COMPLETE = np.random.default_rng(0).normal([0, 0.5, 1], 1, size=(6, 3))


def test_skillings_and_mack_is_that_of_the_printed_example():
    found = skillings_mack(ASSEMBLY)
    assert found.statistic == pytest.approx(15.493049, abs=1e-6)
    assert found.p_value == pytest.approx(0.001440296302, abs=1e-12)
    assert (found.degrees_of_freedom, found.num_environments, found.test) == (3, 9, "Skillings–Mack")


def test_friedman_is_scipys():
    found = friedman(np.round(COMPLETE, 0))
    theirs = stats.friedmanchisquare(*np.round(COMPLETE, 0).T)
    assert (found.statistic, found.p_value) == pytest.approx(tuple(theirs))
    assert found.degrees_of_freedom == 2


def test_with_nothing_missing_and_no_ties_both_are_the_same():
    one, other = friedman(COMPLETE), skillings_mack(COMPLETE)
    assert (one.statistic, one.p_value, one.p_permutation) == pytest.approx((other.statistic, other.p_value, other.p_permutation))


def test_the_permutation_p_value_is_that_of_all_permutations():
    table = COMPLETE[:4]
    ranks = stats.rankdata(table, axis=1)
    observed = np.sum((ranks.sum(0) - 8) ** 2)
    every = list(product(list(permutations([1, 2, 3])), repeat=4))
    share = np.mean([np.sum((np.sum(rows, axis=0) - 8) ** 2) >= observed for rows in every])
    assert friedman(table, resamples=40_000).p_permutation == pytest.approx(share, abs=0.01)


def test_the_best_algorithm_has_rank_one():
    assert friedman([[3.0, 1, 2], [30, 10, 20]]).mean_ranks == (1, 3, 2)
    assert skillings_mack([[3.0, NAN, 2], [NAN, 10, 20], [1.0, 0.0, NAN]]).mean_ranks == (1, 2, 1.5)


def test_an_environment_with_one_algorithm_changes_nothing():
    alone = np.vstack([ASSEMBLY, [NAN, NAN, 5.0, NAN]])
    assert skillings_mack(alone) == skillings_mack(ASSEMBLY)


def test_equal_scores_do_not_differ():
    for test in (friedman, skillings_mack):
        found = test(np.ones((4, 3)))
        assert (found.statistic, found.p_value, found.p_permutation) == (0, 1, 1)


def test_permutations_stay_within_environments_and_repeat_by_seed():
    # always the same order: of 6³ arrangements, 6 are as extreme
    table = np.arange(3.0) + 100 * np.arange(3)[:, None]
    assert friedman(table, resamples=40_000).p_permutation == pytest.approx(6 / 216, abs=0.004)
    assert friedman(table, seed=1) == friedman(table, seed=1)
    assert friedman(table, seed=1).p_permutation != friedman(table, seed=2).p_permutation


def test_what_has_no_ranks_is_refused():
    with pytest.raises(UserError, match="4 cells are missing; `skillings_mack` does without them"):
        friedman(ASSEMBLY)
    with pytest.raises(UserError, match="compares at least 3 algorithms"):
        friedman(COMPLETE[:, :2])
    with pytest.raises(TooFewRunsError, match="over environments, needs at least 2 runs"):
        friedman(COMPLETE[:1])
    with pytest.raises(UserError, match="some algorithms share no environment"):
        skillings_mack([[1.0, 2, NAN, NAN], [2.0, 1, NAN, NAN], [NAN, NAN, 1, 2], [NAN, NAN, 2, 1]])
    with pytest.raises(UserError, match="1 cells are infinite"):
        friedman(np.where(COMPLETE[0, 0] == COMPLETE, np.inf, COMPLETE))
