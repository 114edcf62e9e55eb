"""Resampling of seeds: what is shared, what is not, and the constants of normal maxima."""

import math

import numpy as np
import pytest

from analysis.statistics import seed_resampling
from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.seed_resampling import (
    expected_maximum,
    half_splits,
    need_complete,
    noise_deviation,
    resampled_means,
    seed_counts,
    winners,
)
from sweep.messages import UserError


def test_expected_maxima_are_those_known_in_closed_form_and_from_tables():
    assert expected_maximum(1) == pytest.approx(0, abs=1e-12)
    assert expected_maximum(2) == pytest.approx(1 / math.sqrt(math.pi))
    assert expected_maximum(3) == pytest.approx(1.5 / math.sqrt(math.pi))
    assert 2 * expected_maximum(5) == pytest.approx(2.32593, abs=1e-5)  # d2 of control charts
    assert expected_maximum(150) == pytest.approx(2.649, abs=5e-4)


def test_the_expected_maximum_of_many_agrees_with_a_simulation():
    draws = np.random.default_rng(0).standard_normal((2_000, 5_000)).max(axis=1)
    assert expected_maximum(5_000) == pytest.approx(draws.mean(), abs=4 * draws.std() / math.sqrt(2_000))


def test_a_resample_draws_as_many_seeds_as_there_are():
    counts = seed_counts(7, 500, np.random.default_rng(0))
    assert (counts.sum(axis=1) == 7).all()
    assert counts.mean(axis=0) == pytest.approx(np.ones(7), abs=0.2)


def test_paired_resamples_keep_differences_that_are_the_same_on_all_seeds():
    scores = np.array([[0.0, 5, 9, 2], [1.0, 6, 10, 3]])
    (paired,) = resampled_means(scores, 200, np.random.default_rng(0))
    (alone,) = resampled_means(scores, 200, np.random.default_rng(0), paired=False)
    assert paired[:, 1] - paired[:, 0] == pytest.approx(np.ones(200))
    assert np.std(alone[:, 1] - alone[:, 0]) > 1
    for means in (paired, alone):  # the standard error, with the divisor n
        assert means[:, 0].std() == pytest.approx(scores[0].std() / 2, rel=0.15)


@pytest.mark.parametrize("paired", [True, False])
def test_blocks_make_no_difference(paired, monkeypatch):
    scores = np.random.default_rng(1).normal(size=(3, 4, 5))
    whole = np.concatenate(list(resampled_means(scores, 50, np.random.default_rng(2), paired=paired)))
    monkeypatch.setattr(seed_resampling, "_BLOCK", 200)
    blocks = list(resampled_means(scores, 50, np.random.default_rng(2), paired=paired))
    assert len(blocks) > 1
    assert np.concatenate(blocks) == pytest.approx(whole)


@pytest.mark.parametrize("num_seeds", [2, 5])
def test_halves_are_disjoint_and_their_weights_give_means(num_seeds):
    choosing, scoring = half_splits(num_seeds, 100, np.random.default_rng(0))
    assert ((choosing > 0) != (scoring > 0)).all()
    assert ((choosing > 0).sum(axis=1) == num_seeds // 2).all()
    assert choosing.sum(axis=1) == pytest.approx(np.ones(100))
    assert scoring.sum(axis=1) == pytest.approx(np.ones(100))


def test_of_settings_equal_but_for_rounding_the_first_wins():
    assert winners(np.array([[0.3, 0.1 + 0.2, 0.2], [1, 2, 3]])).tolist() == [0, 2]
    assert winners(np.array([-1e3, -1e3 + 1e-6])) == 1


def test_noise_leaves_out_the_luck_that_settings_share():
    luck = np.array([0.0, 100, -50])
    assert noise_deviation(np.stack([luck, luck + 7])) == pytest.approx(0)
    # residuals of [0, 2], [0, 0]: ±1/2 after both means; (2−1)(2−1) degrees of freedom
    assert noise_deviation(np.array([[0.0, 2], [0, 0]])) == pytest.approx(1)
    # without: 1, 1, 0, 0 squared over 2 degrees of freedom
    assert noise_deviation(np.array([[0.0, 2], [0, 0]]), paired=False) == pytest.approx(1)
    assert noise_deviation(np.array([[0.0, 2], [0, 2]]), paired=False) == pytest.approx(math.sqrt(2))


def test_missing_scores_are_counted_and_one_seed_is_too_few():
    with pytest.raises(UserError, match=r"a test needs a score of every run: 1 of 2 settings lack some"):
        need_complete(np.array([[1.0, 2], [3, np.nan]]), "a test", "HS")
    with pytest.raises(TooFewRunsError, match="at least 2 runs"):
        need_complete(np.ones((3, 1)), "a test", "HS")
    with pytest.raises(UserError, match=r"scores \[E, H, S\]"):
        need_complete(np.ones((3, 2)), "a test", "EHS")
