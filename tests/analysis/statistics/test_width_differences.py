"""Differences of widths: exact where nothing is noisy, and intervals that cover about what they say with two seeds."""

import numpy as np
import pytest

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.width_differences import width_difference, width_less_reach
from sweep.messages import UserError


def region(lines, spread=0.0, seeds=2, generator=None, gap=1_000):
    """Scores [X, L, 2, S]: the first remaining setting has the lines' means, the second is `gap` below."""
    means = np.stack([np.asarray(lines, float), np.asarray(lines, float) - gap], axis=-1)
    noise = generator.normal(0, spread, (*means.shape, seeds)) if generator else 0
    return np.repeat(means[..., None], seeds, axis=-1) + noise


NARROW = [[0, 10], [100, 120], [300, 300]]  # widths 10, 20, 0; means of the lines 5, 110, 300
WIDE = [[0, 40], [100, 150], [300, 330]]  # widths 40, 50, 30
LEAST = 1 / 2_001


def test_without_noise_the_difference_is_that_of_the_mean_widths():
    estimate, below, above = width_difference(region(NARROW), region(WIDE))
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((-30, -30, -30))
    assert (below, above) == pytest.approx((LEAST, 1))
    assert width_difference(region(WIDE), region(NARROW))[1:] == pytest.approx((1, LEAST))


def test_without_noise_the_reach_is_that_of_the_mean_of_the_lines():
    estimate, below, above = width_less_reach(region(NARROW))
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((-285, -285, -285))
    assert (below, above) == pytest.approx((LEAST, 1))
    estimate, below, above = width_less_reach(region([[0, 50], [1, 51]]))
    assert (estimate.value, below, above) == pytest.approx((49, 1, LEAST))


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
    for _ in range(150):
        estimate, _, _ = width_difference(region(lines, 10, 2, generator), region(wider, 10, 2, generator))
        covered += estimate.low <= -40 <= estimate.high
    assert covered / 150 >= 0.88  # standard errors of two seeds are rough: 95 % nominal


@pytest.mark.parametrize("gap", [1_000, 0])  # one remaining setting that counts, or two that are equally good
def test_noise_alone_does_not_make_one_region_wider_than_another(gap):
    """Neither has any width, and one is three times as noisy: both errors are rare."""
    generator = np.random.default_rng(1)
    flat = np.zeros((5, 5))
    narrower = wider = 0
    for _ in range(150):
        _, below, above = width_difference(region(flat, 10, 2, generator, gap), region(flat, 30, 2, generator, gap))
        narrower, wider = narrower + (below < 0.05), wider + (above < 0.05)
    assert narrower / 150 <= 0.1
    assert wider / 150 <= 0.1


def test_one_seed_or_an_unfinished_setting_have_no_interval():
    with pytest.raises(TooFewRunsError, match="needs at least 2 runs"):
        width_difference(region(NARROW, seeds=1), region(WIDE))
    scores = region(NARROW)
    scores[1, 1, 0, 1] = np.nan
    with pytest.raises(UserError, match="needs a score of every run"):
        width_less_reach(scores)
    scores = region(NARROW)
    scores[1, 1] = np.nan
    with pytest.raises(UserError, match="needs every line at every x-value"):
        width_difference(region(NARROW), scores)
