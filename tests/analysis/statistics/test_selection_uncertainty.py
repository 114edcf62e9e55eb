"""The bootstrap of a selection and its bias, against cases that can be counted and normal data with a known bias."""

import numpy as np
import pytest

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.seed_resampling import expected_maximum
from analysis.statistics.selection_uncertainty import bootstrap_selection, gaussian_bias, maximization_bias
from sweep.messages import UserError

# Of the four equally likely resamples (1,1), (1,2), (2,1), (2,2) the second setting wins three: 0 < 6, 5 < 6, 5 < 6, 10 > 6
COUNTED = np.array([[0.0, 10], [6, 6]])
# paired: loses (1,1), ties (1,2) and (2,1), wins (2,2)
MIRRORED = np.array([[0.0, 10], [10, 0]])


def test_a_setting_wins_as_often_as_counted():
    found = bootstrap_selection(COUNTED, resamples=20_000, seed=0)
    assert (found.winner, found.runner_up, found.num_settings, found.num_runs) == (1, 0, 2, 2)
    assert found.probabilities == pytest.approx([0.25, 0.75], abs=0.015)
    assert found.changed == pytest.approx(found.probabilities[0])
    assert found.uncertainty_set == (1, 0)
    assert found.winner_means.mean() == pytest.approx(0.25 * 5 + 0.75 * 6, abs=0.02)


def test_pairing_matters_and_ties_go_to_the_first():
    paired = bootstrap_selection(MIRRORED, resamples=20_000, seed=0)
    alone = bootstrap_selection(MIRRORED, paired=False, resamples=20_000, seed=0)
    assert paired.probabilities[0] == pytest.approx(3 / 4, abs=0.015)
    assert alone.probabilities[0] == pytest.approx(11 / 16, abs=0.015)  # of 0, 5, 5, 10 against 0, 5, 5, 10


def test_the_uncertainty_set_leaves_out_rare_winners():
    found = bootstrap_selection(COUNTED, threshold=0.3, resamples=4_000, seed=0)
    assert found.uncertainty_set == (1,)


def test_the_lead_is_the_difference_of_means_and_its_interval_that_of_paired_differences():
    lead = bootstrap_selection(COUNTED, resamples=4_000, seed=0).lead
    assert (lead.value, lead.low, lead.high) == (1, -4, 6)  # differences 6, 1, 1, −4, the ends each in a quarter
    shifted = bootstrap_selection(COUNTED + np.array([1_000, -1_000]), resamples=4_000, seed=0).lead
    assert (shifted.value, shifted.low, shifted.high) == pytest.approx((1, -4, 6))


def test_one_setting_has_no_runner_up_and_no_bias():
    found = bootstrap_selection(np.array([[1.0, 5, 2]]), seed=0)
    assert (found.winner, found.runner_up, found.lead, found.changed) == (0, None, None, 0)
    bias = maximization_bias(np.array([[1.0, 5, 2]]), seed=0)
    assert (bias.bootstrap, bias.split_half, bias.gaussian) == pytest.approx((0, 0, 0))


def test_the_same_seed_gives_the_same_numbers_and_another_others():
    scores = np.random.default_rng(0).normal(size=(20, 6))
    first, same, other = (bootstrap_selection(scores, seed=seed).probabilities for seed in (1, 1, 2))
    assert (first == same).all()
    assert (first != other).any()


def test_the_biases_are_those_counted():
    bias = maximization_bias(COUNTED, resamples=20_000, seed=0)
    assert bias.bootstrap == pytest.approx(5 / 4, abs=4 * bias.bootstrap_error)  # 10 − 5 in a quarter
    assert bias.split_half == pytest.approx(5, abs=4 * bias.split_half_error)  # 10 − 0, or 6 − 6
    assert 0 < bias.bootstrap_error < 0.03
    assert 0 < bias.split_half_error < 0.06


def test_a_clear_winner_has_no_bias():
    bias = maximization_bias(np.array([[0.0, 1, 2, 3], [103.0, 100, 101, 102]]), seed=0)
    assert (bias.bootstrap, bias.split_half) == (0, 0)


def test_the_gaussian_reference_is_that_of_150_settings():
    assert [gaussian_bias(1, 150, n) for n in (10, 3, 30)] == pytest.approx([0.84, 1.53, 0.48], abs=0.005)


def test_what_seeds_do_to_all_settings_alike_is_no_noise():
    luck = np.random.default_rng(1).normal(0, 50, size=6)
    scores = np.random.default_rng(0).normal(size=(10, 6))
    plain, lucky = maximization_bias(scores, seed=0), maximization_bias(scores + luck, seed=0)
    assert lucky.noise == pytest.approx(plain.noise)
    assert lucky.bootstrap == pytest.approx(plain.bootstrap, abs=0.3)
    assert maximization_bias(scores + luck, paired=False, seed=0).noise > 10


def test_with_equally_good_settings_the_estimates_are_what_they_are_said_to_be():
    generator = np.random.default_rng(0)
    k, n = 20, 10
    found = [maximization_bias(generator.normal(size=(k, n)), resamples=100, seed=seed) for seed in range(150)]
    truth = expected_maximum(k) / np.sqrt(n)
    assert np.mean([bias.gaussian for bias in found]) == pytest.approx(truth, rel=0.02)
    assert np.mean([bias.bootstrap for bias in found]) == pytest.approx(truth * np.sqrt(1 / 2), rel=0.12)
    assert np.mean([bias.split_half for bias in found]) == pytest.approx(truth * np.sqrt(2), rel=0.12)


def test_missing_runs_and_single_seeds_are_refused():
    for function in (bootstrap_selection, maximization_bias):
        with pytest.raises(UserError, match="1 of 2 settings lack some"):
            function(np.array([[1.0, np.nan], [1, 2]]), seed=0)
        with pytest.raises(TooFewRunsError):
            function(np.ones((2, 1)), seed=0)
