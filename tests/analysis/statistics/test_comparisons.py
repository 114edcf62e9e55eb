"""Comparisons of two groups: scipy, enumeration, printed numbers, and what is refused."""

import math
from itertools import combinations, product

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.comparisons import TESTS, compare
from analysis.statistics.estimate import TooFewRunsError
from sweep.messages import UserError

# Student's sleep data (1908), extra hours of ten people with either drug; R: Welch t = −1.8608, df = 17.776, p = 0.07939,
# interval −3.365 to 0.205; paired t = −4.0621, p = 0.002833, interval −2.460 to −0.700
FIRST = np.array([0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0])
SECOND = np.array([1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4])
FEW = np.array([1.0, 4.0, 6.0]), np.array([2.0, 7.0, 8.0, 9.0])


def test_welch_is_that_of_the_printed_sleep_data():
    found = compare(FIRST, SECOND)
    assert found.p_value == pytest.approx(0.07939, abs=1e-5)
    ends = (found.difference.value, found.difference.low, found.difference.high)
    assert ends == pytest.approx((-1.58, -3.3654832, 0.2054832), abs=1e-6)
    assert (found.test, found.difference.method, found.num_first, found.num_second, found.exact) == (
        "welch",
        "Welch",
        10,
        10,
        False,
    )


def test_a_paired_t_test_is_that_of_the_printed_sleep_data():
    found = compare(FIRST, SECOND, "paired_t")
    assert found.p_value == pytest.approx(0.002833, abs=1e-6)
    assert (found.difference.low, found.difference.high) == pytest.approx((-2.4598858, -0.7001142), abs=1e-6)


def test_a_permutation_test_of_few_runs_goes_through_all_of_them():
    first, second = FEW
    pool, gap = np.concatenate(FEW), first.mean() - second.mean()
    gaps = [pool[list(chosen)].mean() - np.delete(pool, chosen).mean() for chosen in combinations(range(7), 3)]
    lower = np.mean(np.array(gaps) <= gap + 1e-12)
    found = compare(first, second, "permutation")
    assert found.exact and found.p_value == pytest.approx(2 * lower)
    assert found.difference.value == gap and found.difference.method == "Welch"


def test_a_paired_permutation_test_of_few_runs_goes_through_all_signs():
    found = compare(FIRST, SECOND, "paired_permutation")
    gaps = FIRST - SECOND
    means = np.array([np.mean(signs * gaps) for signs in product([1, -1], repeat=10)])
    assert found.exact
    assert found.p_value == pytest.approx(2 * np.mean(means <= gaps.mean() + 1e-12))


@pytest.mark.parametrize("test", ["permutation", "paired_permutation"])
def test_a_permutation_test_of_many_runs_never_gives_zero(test):
    first = np.random.default_rng(0).normal(size=20)
    found = compare(first + 50 + first, first, test, resamples=999)
    assert not found.exact
    assert found.p_value == pytest.approx(2 / 1000)  # (0 + 1) / (999 + 1) on either side


def test_a_permutation_test_agrees_with_the_t_test_on_normal_runs():
    first, second = np.random.default_rng(5).normal([[0], [0.4]], 1, size=(2, 40))
    assert compare(first, second, "permutation").p_value == pytest.approx(compare(first, second).p_value, abs=0.01)


def test_a_paired_bootstrap_rejects_where_its_interval_leaves_out_zero():
    found = compare(FIRST, SECOND, "paired_bootstrap")
    means = np.random.default_rng(9).choice(FIRST - SECOND, (200_000, 10)).mean(1)
    low, high = np.quantile(means, [0.025, 0.975])
    assert (found.difference.low, found.difference.high) == pytest.approx((low, high), abs=0.05)
    assert found.p_value == pytest.approx(2 / 10_001)  # all differences but one are negative: no mean reached 0
    gaps = np.random.default_rng(2).normal(0.4, 1, 12)
    found = compare(gaps, np.zeros(12), "paired_bootstrap")
    means = np.random.default_rng(9).choice(gaps, (200_000, 12)).mean(1)
    assert found.p_value == pytest.approx(2 * np.mean(means <= 0), abs=0.01)
    assert 0 < found.p_value < 1


def test_mann_whitney_is_scipys_and_exact_for_few_runs_without_ties():
    few = compare(*FEW, "mann_whitney")
    assert few.exact and few.p_value == stats.mannwhitneyu(*FEW, method="exact").pvalue
    # R's wilcox.test of the sleep data: W = 25.5, p = 0.06933
    found = compare(FIRST, SECOND, "mann_whitney")
    assert not found.exact and found.p_value == pytest.approx(0.06933, abs=1e-5)
    assert found.difference.method == "Hodges–Lehmann"
    assert found.difference.value == pytest.approx(np.median(np.subtract.outer(FIRST, SECOND)))


def test_mann_whitney_of_more_than_eight_runs_is_that_of_the_normal_distribution():
    first, second = np.random.default_rng(3).normal(size=(2, 9))
    found = compare(first, second, "mann_whitney")
    assert not found.exact and found.p_value == stats.mannwhitneyu(first, second, method="asymptotic").pvalue


def test_ranks_see_what_a_collapsed_run_hides_from_means():
    first, second = np.arange(10.0) + 20, np.arange(10.0)
    first[0] = -1_000
    assert compare(first, second, "mann_whitney").p_value < 0.01 < 0.3 < compare(first, second).p_value


@pytest.mark.parametrize("test", TESTS)
def test_the_first_group_being_higher_is_a_positive_difference(test):
    found, turned = compare(SECOND, FIRST, test), compare(FIRST, SECOND, test)
    assert found.difference.value > 0 > turned.difference.value
    assert found.difference.low < found.difference.value < found.difference.high
    assert found.effects.cohen_d > 0 and found.effects.cliffs_delta > 0
    assert found.p_value == pytest.approx(turned.p_value, abs=0.02)


@pytest.mark.parametrize("test", TESTS)
def test_two_groups_of_one_number_do_not_differ(test):
    found = compare([0.1] * 4, [0.1] * 4, test)
    # four against four ranks have an interval, of the width 0
    assert (found.difference.value, found.difference.low, found.difference.high) == (0, 0, 0)
    assert found.p_value == 1


@pytest.mark.parametrize("test", ["welch", "paired_t"])
def test_groups_that_do_not_vary_differ_with_certainty(test):
    found = compare([0.3] * 3, [0.1] * 3, test)
    assert found.p_value == 0
    assert found.difference.low == found.difference.high == pytest.approx(0.2)


def test_tests_that_draw_are_repeated_by_their_seed():
    first, second = np.random.default_rng(1).normal([[0], [0.5]], 1, size=(2, 15))
    for test in ("permutation", "paired_permutation", "paired_bootstrap"):
        found = compare(first, second, test, seed=4, resamples=500)
        assert found == compare(first, second, test, seed=4, resamples=500)
        assert found.p_value != compare(first, second, test, seed=6, resamples=500).p_value


def test_another_level_gives_another_interval_and_the_same_p_value():
    for test in TESTS:
        narrow, wide = compare(FIRST, SECOND, test, confidence=0.5), compare(FIRST, SECOND, test, confidence=0.95)
        assert wide.difference.low < narrow.difference.low and narrow.difference.high < wide.difference.high
        assert narrow.difference.confidence == 0.5 and narrow.p_value == wide.p_value


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(UserError, match=r'unknown test "welsh"; did you mean "welch"\?'):
        compare(FIRST, SECOND, "welsh")
    for test in TESTS:
        with pytest.raises(TooFewRunsError, match="of the second group needs at least 2 runs, and there is 1 run"):
            compare(FIRST, [1.0], test)
        with pytest.raises(UserError, match="1 of 2 scores is NaN"):
            compare([1.0, math.nan], [1.0, 2.0], test)
    for test in ("paired_t", "paired_bootstrap", "paired_permutation"):
        with pytest.raises(UserError, match="runs are paired by seed, and there are 10 and 9"):
            compare(FIRST, SECOND[:9], test)
