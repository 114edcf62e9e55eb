"""Power of Welch's test: printed numbers, and simulation where variances differ."""

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.power import _error, runs_to_detect, welch_power
from sweep.messages import UserError


@pytest.mark.parametrize(("effect", "needed"), [(0.2, 394), (0.5, 64), (0.8, 26), (1.0, 17)])
def test_the_printed_numbers_of_runs_are_needed_for_a_power_of_80_percent(effect, needed):
    # two-sided 5 %, as Cohen's tables and G*Power have them
    assert runs_to_detect(effect) == needed
    assert runs_to_detect(-10 * effect, deviation=10.0) == needed


def test_more_power_and_a_stricter_level_need_the_printed_numbers():
    assert runs_to_detect(0.5, power=0.9) == 86
    assert runs_to_detect(0.5, alpha=0.01) == 96


def test_no_difference_is_found_as_often_as_the_level_says():
    assert welch_power(0, 10) == pytest.approx(0.05)
    assert welch_power(0, (5, 9), (1.0, 3.0), alpha=0.01) == pytest.approx(0.01)


@pytest.mark.parametrize(("runs", "deviations"), [((10, 10), (1.0, 3.0)), ((8, 24), (2.0, 1.0))])
def test_power_is_how_often_welch_finds_the_difference(runs, deviations):
    rng = np.random.default_rng(0)
    first = rng.normal(2.0, deviations[0], (20_000, runs[0]))
    second = rng.normal(0.0, deviations[1], (20_000, runs[1]))
    found = np.mean(stats.ttest_ind(first, second, axis=1, equal_var=False).pvalue < 0.05)
    # degrees of freedom are those of the true variances: an approximation that is off by a point
    assert welch_power(2.0, runs, deviations) == pytest.approx(found, abs=0.015)


def test_degrees_of_freedom_are_those_of_welch_and_satterthwaite():
    # variances of the means 4/8 and 1/24: (13/24)² / (0.25 / 7 + 1/576 / 23) = 8.198
    assert _error(8, 24, 2.0, 1.0) == pytest.approx((0.73598, 8.198), rel=1e-4)


def test_an_effect_beyond_doubt_is_found_with_two_runs():
    assert welch_power(1_000, 10) == 1
    assert runs_to_detect(1_000) == 2


def test_what_has_no_power_is_refused():
    with pytest.raises(TooFewRunsError):
        welch_power(1.0, (1, 5))
    with pytest.raises(UserError, match="no number of runs detects that"):
        runs_to_detect(0)
    with pytest.raises(UserError, match="over 10,000,000 runs are needed"):
        runs_to_detect(1e-6)
    with pytest.raises(UserError, match="is not positive"):
        welch_power(1.0, 5, 0.0)
    with pytest.raises(UserError, match="power: 80 is not"):
        runs_to_detect(1.0, power=80)
