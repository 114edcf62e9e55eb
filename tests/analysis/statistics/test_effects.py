"""Effect sizes of small groups, worked out by hand."""

import math

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.effects import effect_sizes
from analysis.statistics.estimate import TooFewRunsError
from sweep.messages import UserError


def test_effect_sizes_of_a_small_table_are_those_worked_out_by_hand():
    # means 4 and 2, variances 4 (3 runs) and 1 (3 runs): pooled standard deviation √2.5
    found = effect_sizes([2.0, 4.0, 6.0], [1.0, 2.0, 3.0])
    assert found.cohen_d == pytest.approx(2 / math.sqrt(2.5))
    # Γ(2) / (√2 Γ(1.5)) = 1 / (√2 · √π / 2) = 0.7979
    assert found.hedges_g == pytest.approx(found.cohen_d * math.sqrt(2 / math.pi))
    # of 9 pairs the first is higher in 7 (2 > 1, 4 and 6 over all), equal in one, lower in one
    assert found.probability_of_superiority == pytest.approx(7.5 / 9)
    assert found.cliffs_delta == pytest.approx((7 - 1) / 9)


def test_unequal_numbers_of_runs_weigh_variances_by_their_degrees_of_freedom():
    found = effect_sizes([0.0, 2.0], [1.0, 2.0, 3.0, 4.0, 5.0])  # variances 2 with 1, 2.5 with 4
    assert found.cohen_d == pytest.approx(-2 / math.sqrt((2 + 10) / 5))


def test_the_correction_of_hedges_is_that_of_the_printed_approximation():
    first, second = np.random.default_rng(0).normal(size=(2, 15))
    found = effect_sizes(first, second)
    assert found.hedges_g / found.cohen_d == pytest.approx(1 - 3 / (4 * 28 - 1), abs=1e-4)


def test_superiority_is_mann_and_whitneys_statistic():
    first, second = np.round(np.random.default_rng(0).normal(size=20), 1), np.round(np.random.default_rng(1).normal(size=13), 1)
    pairs = stats.mannwhitneyu(first, second).statistic / (20 * 13)
    assert effect_sizes(first, second).probability_of_superiority == pytest.approx(pairs)


def test_groups_without_variation_differ_infinitely_or_not_at_all():
    # the rounded variance of three times 0.1 is not 0
    assert effect_sizes([0.1] * 3, [0.2] * 3).cohen_d == -math.inf
    assert effect_sizes([0.1] * 3, [0.2] * 3).cliffs_delta == -1
    same = effect_sizes([0.1] * 3, [0.1] * 3)
    assert (same.cohen_d, same.hedges_g, same.cliffs_delta, same.probability_of_superiority) == (0, 0, 0, 0.5)


def test_what_has_no_effect_size_is_refused():
    with pytest.raises(TooFewRunsError):
        effect_sizes([1.0], [1.0, 2.0])
    with pytest.raises(UserError, match="1 of 2 scores is NaN"):
        effect_sizes([1.0, 2.0], [math.nan, 2.0])
