"""Distributions over settings, against enumeration and scipy."""

import itertools

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.setting_distribution import best_of, best_weights, distribution
from sweep.messages import UserError

SCORES = np.array([[3.0, 5], [1, 1], [7, 11], [1, 1], [0, -4]])
MEANS = [4.0, 1, 9, 1, -2]


def test_the_distribution_is_the_empirical_one_of_the_means():
    curve = distribution(SCORES, seed=0)
    known = stats.ecdf(MEANS).cdf
    assert curve.x.tolist() == known.quantiles.tolist() == [-2, 1, 4, 9]
    assert curve.value.tolist() == known.probabilities.tolist()
    assert (curve.num_settings, curve.num_runs, curve.resamples, curve.seed) == (5, 2, 1_000, 0)


def test_a_share_is_of_settings_at_most_the_threshold():
    assert distribution(SCORES, np.array([8.9, 0.0, 1, 100]), seed=0).value.tolist() == [0.2, 0.6, 0.8, 1]


def test_the_band_has_the_resamples_in_it():
    curve = distribution(SCORES, np.array([3.5, 8.0]), resamples=4_000, seed=0)
    # the first setting is 3, 4, 4 or 5 and the third 7, 9, 9 or 11, each with probability ¼, ½, ¼
    assert (curve.low.tolist(), curve.high.tolist()) == ([0.6, 0.8], [0.8, 1.0])


@pytest.mark.parametrize("replacement", [False, True])
def test_the_best_of_m_is_that_of_all_draws_counted(replacement):
    found = best_of(SCORES, 4, replacement=replacement, seed=0)
    for m in range(1, 5):
        draws = itertools.product(MEANS, repeat=m) if replacement else itertools.combinations(MEANS, m)
        assert found.curve.value[m - 1] == pytest.approx(np.mean([max(draw) for draw in draws]))


def test_the_best_of_all_is_the_best_and_of_one_the_mean():
    curve = best_of(SCORES, seed=0).curve
    assert curve.x.tolist() == [1, 2, 3, 4, 5]
    assert (curve.value[0], curve.value[-1]) == pytest.approx((np.mean(MEANS), 9))
    assert (curve.low <= curve.value).all()
    assert (curve.value <= curve.high).all()


@pytest.mark.parametrize("replacement", [False, True])
def test_weights_of_many_settings_sum_up_to_one(replacement):
    weights = best_weights(2_000, 2_000, replacement=replacement)
    assert weights.sum(axis=1) == pytest.approx(np.ones(2_000), rel=1e-8)
    assert (weights >= 0).all()


def test_split_halves_score_on_seeds_that_did_not_choose():
    # chosen on seed 1: the second, which scores 0 on seed 2; chosen on seed 2: the first, which scores 0 on seed 1
    found = best_of(np.array([[0.0, 10], [10, 0]]), resamples=4_000, seed=0)
    assert found.split_half[1] == 0
    assert found.split_half[0] == pytest.approx(5, abs=0.3)
    assert found.curve.value.tolist() == [5, 5]


def test_the_split_half_is_unbiased_where_no_setting_is_better():
    generator = np.random.default_rng(0)
    found = [best_of(generator.normal(size=(30, 10)), resamples=50, seed=seed) for seed in range(100)]
    assert np.mean([best.curve.value[-1] for best in found]) == pytest.approx(2.04 / np.sqrt(10), rel=0.1)  # E max of 30
    assert np.mean([best.split_half[-1] for best in found]) == pytest.approx(0, abs=0.1)


def test_bad_requests_are_refused():
    with pytest.raises(UserError, match="6 settings cannot be drawn"):
        best_of(SCORES, 6, seed=0)
    assert len(best_of(SCORES, 6, replacement=True, seed=0).curve.x) == 6
    with pytest.raises(UserError, match="0 settings cannot be drawn"):
        best_of(SCORES, 0, seed=0)
    with pytest.raises(TooFewRunsError):
        distribution(SCORES[:, :1], seed=0)
    with pytest.raises(UserError, match="lack some"):
        best_of(np.array([[1.0, np.nan]]), seed=0)
