"""Tolerance intervals: published numbers of runs and levels, and what few runs attain."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.tolerance import runs_needed, tolerance_interval
from sweep.messages import UserError


def min_max_confidence(n, beta):
    """The closed form for lowest to highest (Wilks 1941)."""
    return 1 - n * beta ** (n - 1) + (n - 1) * beta**n


@pytest.mark.parametrize(("beta", "needed"), [(0.9, 46), (0.95, 93), (0.5, 8), (0.99, 473)])
def test_the_printed_numbers_of_runs_are_needed(beta, needed):
    assert runs_needed(0.05, beta) == needed
    assert min_max_confidence(needed, beta) >= 0.95 > min_max_confidence(needed - 1, beta)


@pytest.mark.parametrize(("n", "confidence", "share"), [(30, 0.816, 0.851), (10, 0.264, 0.606)])
def test_few_runs_state_what_they_attain(n, confidence, share):
    found = tolerance_interval(np.arange(n)[::-1], 0.05, 0.9)
    assert (found.low, found.high, found.low_rank, found.high_rank) == (0, n - 1, 1, n)
    assert found.attained_confidence == pytest.approx(confidence, abs=5e-4)
    assert found.attained_confidence == pytest.approx(min_max_confidence(n, 0.9))
    assert found.attained_beta == pytest.approx(share, abs=5e-4)
    assert min_max_confidence(n, found.attained_beta) == pytest.approx(0.95)
    assert not found.holds
    assert found.describe() == (
        f"lowest to highest of {n} runs: contains a share 0.9 of runs with confidence {confidence:.3f} only, "
        f"and a share {share:.3f} with 0.95; 46 runs are needed"
    )


def test_enough_runs_attain_what_was_asked():
    at_46, at_45 = tolerance_interval(range(46)), tolerance_interval(range(45))
    assert at_46.holds and not at_45.holds
    assert (at_46.low, at_46.high) == (0, 45)
    assert at_46.describe() == "contains a share 0.9 of runs with confidence 0.952"
    assert at_46.attained_beta > 0.9 > at_45.attained_beta


def test_more_runs_leave_out_as_many_as_they_can_and_the_odd_one_above():
    found = tolerance_interval(range(1, 101), 0.05, 0.9)
    assert (found.low_rank, found.high_rank) == (found.low, found.high) == (2, 98)
    # one run less between the ends would attain too little
    width = found.high_rank - found.low_rank
    assert stats.beta.sf(0.9, width, 101 - width) >= 0.95 > stats.beta.sf(0.9, width - 1, 102 - width)


@given(st.integers(2, 300), st.floats(0.01, 0.5), st.floats(0.1, 0.99))
def test_what_is_attained_is_the_distribution_of_the_share_between_two_order_statistics(n, alpha, beta):
    found = tolerance_interval(range(n), alpha, beta)
    width = found.high_rank - found.low_rank
    assert 1 <= found.low_rank < found.high_rank <= n
    assert found.attained_confidence == pytest.approx(stats.beta.sf(beta, width, n - width + 1), abs=1e-9)
    assert stats.beta.cdf(found.attained_beta, width, n - width + 1) == pytest.approx(alpha, abs=1e-6)
    assert found.holds == (n >= runs_needed(alpha, beta))


def test_what_has_no_tolerance_interval_is_refused():
    with pytest.raises(TooFewRunsError, match="tolerance interval needs at least 2 runs, and there is 1 run"):
        tolerance_interval([1.0])
    with pytest.raises(UserError, match="1 of 2 scores is NaN"):
        tolerance_interval([1.0, np.nan])
    with pytest.raises(UserError, match="beta: 90 is not between 0 and 1"):
        tolerance_interval([1.0, 2.0], 0.05, 90)
    with pytest.raises(UserError, match="alpha: 0 is not"):
        runs_needed(0, 0.9)


def test_equal_runs_have_an_interval_without_width():
    found = tolerance_interval([3.0] * 50)
    assert (found.low, found.high) == (3, 3)
