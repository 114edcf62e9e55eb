"""Hodges and Lehmann's shift: the distribution of U by enumeration, printed tables, and intervals that are tests inverted."""

from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.shift import _distribution, _exact_rank, shift_interval


@pytest.mark.parametrize(("n", "m"), [(1, 3), (2, 2), (3, 4), (5, 2), (6, 6)])
def test_the_distribution_of_u_is_that_of_all_arrangements(n, m):
    counts = np.zeros(n * m + 1)
    for places in combinations(range(n + m), n):
        counts[sum(places) - n * (n - 1) // 2] += 1
    assert _distribution(n, m) == pytest.approx(counts / counts.sum(), abs=1e-14)


@pytest.mark.parametrize(("n", "m", "critical"), [(5, 5, 2), (8, 8, 13), (10, 10, 23), (10, 6, 11), (4, 4, 0), (20, 20, 127)])
def test_the_rank_is_one_more_than_the_printed_critical_value(n, m, critical):
    # two-sided 5 % critical values of U, as in every printed table
    assert _exact_rank(n, m, 0.025) == critical + 1


def test_three_against_three_runs_have_no_interval_at_95_percent():
    assert shift_interval(np.array([1.0, 2, 3]), np.array([0.0, 5, 6]), 0.95)[1:] == (-np.inf, np.inf)


def test_the_interval_holds_the_shifts_that_the_test_does_not_reject():
    first, second = np.random.default_rng(0).normal(size=9) + 1, np.random.default_rng(1).normal(size=7)
    value, low, high = shift_interval(first, second, 0.9)
    assert value == np.median(np.subtract.outer(first, second))

    def p_value(shift):
        return stats.mannwhitneyu(first - shift, second, method="exact").pvalue

    for end, inside in ((low, 1e-9), (high, -1e-9)):
        assert p_value(end + inside) > 0.1 >= p_value(end - inside)


def test_many_pairs_have_the_rank_of_the_normal_distribution():
    first, second = np.random.default_rng(0).normal(size=(2, 60))
    exact = np.count_nonzero(np.cumsum(_distribution(60, 60)) <= 0.025)
    assert _exact_rank(60, 60, 0.025) == pytest.approx(exact, abs=1)
    _, low, high = shift_interval(first, second, 0.95)
    assert stats.mannwhitneyu(first - low, second).pvalue == pytest.approx(0.05, abs=0.002)
    assert stats.mannwhitneyu(first - high, second).pvalue == pytest.approx(0.05, abs=0.002)
