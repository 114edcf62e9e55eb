"""Differences of widths: exact where nothing is noisy, and intervals that cover about what they say with two seeds."""

import numpy as np
import pytest

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.width_differences import width_difference, width_less_reach
from sweep.messages import UserError


def region(lines, spread=0.0, seeds=2, generator=None):
    """Scores [X, L, 2, S]: the first remaining setting has the lines' means, the second is 1,000 below."""
    means = np.stack([np.asarray(lines, float), np.asarray(lines, float) - 1_000], axis=-1)
    noise = generator.normal(0, spread, (*means.shape, seeds)) if generator else 0
    return np.repeat(means[..., None], seeds, axis=-1) + noise


NARROW = [[0, 10], [100, 120], [300, 300]]  # widths 10, 20, 0; means of the lines 5, 110, 300
WIDE = [[0, 40], [100, 150], [300, 330]]  # widths 40, 50, 30


def test_without_noise_the_difference_is_that_of_the_mean_widths():
    estimate, p_value = width_difference(region(NARROW), region(WIDE))
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((-30, -30, -30))
    assert p_value == pytest.approx(1 / 2_001)
    assert width_difference(region(WIDE), region(NARROW))[1] == 1


def test_without_noise_the_reach_is_that_of_the_mean_of_the_lines():
    estimate, p_value = width_less_reach(region(NARROW))
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((-285, -285, -285))
    assert p_value == pytest.approx(1 / 2_001)
    estimate, p_value = width_less_reach(region([[0, 50], [1, 51]]))
    assert (estimate.value, p_value) == (pytest.approx(49), 1)


def test_settings_that_the_study_does_not_have_do_not_count():
    scores = region(NARROW)
    scores[0, :, 1] = np.nan
    assert width_difference(scores, region(WIDE))[0].value == pytest.approx(-30)


def test_the_same_seed_gives_the_same_interval_and_another_one_a_different():
    generator = np.random.default_rng(0)
    first, second = (region(lines, 5, generator=generator) for lines in (NARROW, WIDE))
    assert width_difference(first, second, seed=1) == width_difference(first, second, seed=1)
    assert width_difference(first, second, seed=1)[0].low != width_difference(first, second, seed=2)[0].low


def test_with_two_seeds_and_many_lines_intervals_cover_about_what_they_say():
    generator = np.random.default_rng(0)
    lines = np.array([[0, 30, 60, 90, 120]] * 8) + 200 * np.arange(8)[:, None]
    wider = np.array([[0, 40, 80, 120, 160]] * 8) + 200 * np.arange(8)[:, None]
    covered = 0
    for _ in range(200):
        estimate, _ = width_difference(region(lines, 10, 2, generator), region(wider, 10, 2, generator))
        covered += estimate.low <= -40 <= estimate.high
    assert 0.86 <= covered / 200 <= 0.98  # standard errors of two seeds are rough: 95 % nominal


def test_one_seed_or_an_unfinished_setting_have_no_interval():
    with pytest.raises(TooFewRunsError, match="a width's interval needs at least 2 runs"):
        width_difference(region(NARROW, seeds=1), region(WIDE))
    scores = region(NARROW)
    scores[1, 1, 0, 1] = np.nan
    with pytest.raises(UserError, match="needs a score of every run"):
        width_less_reach(scores)
