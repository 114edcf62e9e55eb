"""Contrasts of means: Welch's test is the one of two groups, Student's that of one; more by the formulas, worked out by hand."""

import math

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.contrasts import contrast
from analysis.statistics.estimate import TooFewRunsError
from sweep.messages import UserError

A, B, C = [3.0, 5.0, 7.0, 9.0], [1.0, 2.0, 6.0], [4.0, 4.5]


def test_two_groups_are_welchs_test():
    found, expected = contrast([A, B], [1, -1]), stats.ttest_ind(A, B, equal_var=False)
    interval = found.interval(0.9)
    assert (interval.low, interval.high) == pytest.approx(expected.confidence_interval(0.9))
    assert found.p_above(0) == pytest.approx(stats.ttest_ind(A, B, equal_var=False, alternative="greater").pvalue)
    assert found.p_below(0) == pytest.approx(stats.ttest_ind(A, B, equal_var=False, alternative="less").pvalue)
    assert interval.num_runs == 3


def test_one_group_is_students_test_against_a_bound():
    found = contrast([A], [1])
    assert found.p_above(4) == pytest.approx(stats.ttest_1samp(A, 4, alternative="greater").pvalue)
    assert found.p_below(4) == pytest.approx(stats.ttest_1samp(A, 4, alternative="less").pvalue)
    assert (found.interval().low, found.interval().high) == pytest.approx(stats.ttest_1samp(A, 4).confidence_interval(0.95))


def test_three_groups_with_weights_by_hand():
    found = contrast([A, B, C], [1, -0.5, -0.5])
    # variances 20/3, 7, 1/8; parts 5/3, 7/12, 1/64
    parts = (5 / 3, 7 / 12, 1 / 64)
    assert found.value == pytest.approx(6 - 1.5 - 2.125)
    assert found.standard_error == pytest.approx(math.sqrt(sum(parts)))
    assert found.degrees == pytest.approx(sum(parts) ** 2 / (parts[0] ** 2 / 3 + parts[1] ** 2 / 2 + parts[2] ** 2))


def test_groups_without_variation_are_certain():
    found = contrast([[2.0, 2.0], [1.0, 1.0]], [1, -1])
    assert (found.interval().low, found.interval().high) == (1, 1)
    assert (found.p_above(0), found.p_above(1), found.p_below(0)) == (0, 1, 1)


def test_what_cannot_be_contrasted_says_why():
    with pytest.raises(TooFewRunsError, match="a contrast needs at least 2 runs, and there is 1 run"):
        contrast([A, [1.0]], [1, -1])
    with pytest.raises(UserError, match="a contrast needs a weight for each group, and there are 1 and 2"):
        contrast([A, B], [1])
    with pytest.raises(UserError, match="1 of 2 scores is NaN"):
        contrast([[1.0, math.nan]], [1])


def test_intervals_of_three_groups_cover_what_they_say():
    generator = np.random.default_rng(0)
    covered = 0
    for _ in range(2_000):
        groups = [generator.normal(mean, scale, size) for mean, scale, size in ((1, 1, 8), (3, 4, 5), (0, 2, 12))]
        interval = contrast(groups, [1, 2, -1]).interval()
        covered += interval.low <= 7 <= interval.high
    assert covered / 2_000 == pytest.approx(0.95, abs=0.02)
