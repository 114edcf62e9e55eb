"""Sensitivity regions: lines and widths by hand, noise floors by simulation, permutations under the null."""

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.regions import Region, arrange, region
from sweep.messages import UserError

QUICK = {"resamples": 200, "permutations": 200, "splits": 50}


def exact(means: list, seeds: int = 2) -> np.ndarray:
    """Return the means [X, L, K] on every seed."""
    return np.repeat(np.array(means, float)[..., None], seeds, axis=-1)


def noisy(*shape: int, seed: int = 0, **scales: float) -> np.ndarray:
    """Return independent normal scores [X, L, K, S] and luck that all share on a seed."""
    generator = np.random.default_rng(seed)
    return generator.normal(size=shape) + scales.get("luck", 0) * generator.normal(size=shape[-1])


def test_a_line_is_the_best_of_the_remaining_settings_and_the_region_lies_between_lines():
    found = region(exact([[[1, 5], [2, 0], [3, 3]], [[7, 1], [7, 2], [4, 7]]]), **QUICK, seed=0)
    assert found.lines.tolist() == [[5, 2, 3], [7, 7, 7]]
    assert (found.low.tolist(), found.high.tolist()) == ([2, 7], [5, 7])
    assert [width.value for width in found.widths] == [3, 0]
    assert (found.mean_width.value, found.best, found.level.value) == pytest.approx((1.5, 7, 31 / 6))
    assert (found.noise, found.mean_noise_floor, found.corrected_width.value) == pytest.approx((0, 0, 1.5))
    assert (found.mean_width.num_runs, found.mean_width.resamples, found.permutations) == (2, 200, 200)


def test_settings_that_a_study_does_not_have_are_no_points():
    scores = exact([[[-5, -1], [-2, 9]]])
    scores[0, 1, 1] = np.nan
    found = region(scores, **QUICK, seed=0)
    assert found.lines.tolist() == [[-1, -2]]
    assert found.split_lines.tolist() == [[-1, -2]]


def test_a_narrow_region_of_failures_shows_its_level():
    found = region(exact([[[-1000, -1000], [-1000, -1000]]]), **QUICK, seed=0)
    assert (found.mean_width.value, found.level.value, found.best) == (0, -1000, -1000)
    assert found.p_value == 1


def test_widths_are_resampled_with_the_same_seeds_for_all_lines():
    luck = np.array([0.0, 50, -20, 7])
    found = region(np.array([1.0, 3]).reshape(1, 2, 1, 1) + luck, **QUICK, seed=0)
    assert (found.mean_width.low, found.mean_width.high) == pytest.approx((2, 2))
    assert found.level.low < found.level.value < found.level.high


def test_luck_that_all_settings_share_moves_no_width_and_no_null():
    plain, lucky = (region(noisy(3, 5, 2, 8, luck=luck), **QUICK, seed=1) for luck in (0, 100))
    assert lucky.p_value == plain.p_value
    assert lucky.noise == pytest.approx(plain.noise)
    assert lucky.noise_floor == pytest.approx(plain.noise_floor)
    assert lucky.mean_width.high == pytest.approx(plain.mean_width.high)


def test_with_one_remaining_setting_the_noise_floor_is_the_range_of_normal_means():
    found = region(noisy(2, 5, 1, 4_000), resamples=2_000, permutations=1, splits=1, seed=0)
    assert found.noise == pytest.approx(1, abs=0.02)
    assert found.gaussian_floor == pytest.approx(2.326 / np.sqrt(4_000), rel=0.02)
    assert found.noise_floor == pytest.approx(found.gaussian_floor, rel=0.05)


@pytest.mark.parametrize(("gaps", "excess"), [(0.0, 1.09), (0.3, 1.0)])
def test_the_noise_floor_is_the_width_that_no_effect_gives_or_up_to_a_tenth_more(gaps, excess):
    means = gaps * np.arange(6)[:, None]  # the remaining settings' own
    found = [
        region(noisy(2, 5, 6, 10, seed=seed) + means, resamples=100, permutations=1, splits=1, seed=0) for seed in range(150)
    ]
    widths = np.array([one.mean_width.value for one in found])
    error = widths.std() / np.sqrt(len(widths))
    assert np.mean([one.mean_noise_floor for one in found]) == pytest.approx(excess * widths.mean(), abs=3 * error)
    assert np.mean([one.gaussian_floor.mean() for one in found]) > 1.1 * widths.mean()


def test_the_corrected_width_is_nearer_to_none_than_the_width():
    found = [region(noisy(2, 5, 1, 10, seed=seed), resamples=200, permutations=1, splits=1, seed=0) for seed in range(60)]
    raw = np.mean([one.mean_width.value for one in found])
    assert np.mean([one.corrected_width.value for one in found]) < 0.75 * raw
    one = found[0]
    assert one.corrected_width.low == pytest.approx(2 * one.mean_width.value - one.mean_width.high)


def test_an_effect_that_is_clear_is_rarer_than_any_permutation():
    effect = np.arange(5).reshape(1, 5, 1, 1)
    assert region(noisy(3, 5, 2, 8) + effect, **QUICK, seed=0).p_value == 1 / 201
    assert region(noisy(3, 5, 2, 8), **QUICK, seed=0).p_value > 0.05


def test_permutations_exchange_lines_within_a_seed_and_a_remaining_setting():
    # 0 and 1 on one seed, 1 and 0 on the other: of the four equally likely permutations two have width 1, two have width 0
    crossed = np.array([[0.0, 1], [1, 0]]).reshape(1, 2, 1, 2)
    assert region(crossed, resamples=2, permutations=400, splits=1, seed=0).p_value == 1
    apart = np.array([[0.0, 0], [1, 1]]).reshape(1, 2, 1, 2)
    assert region(apart, resamples=2, permutations=4_000, splits=1, seed=0).p_value == pytest.approx(1 / 2, abs=0.04)
    # a remaining setting without the second line keeps its own place: the first line is always 5
    third = np.concatenate([apart, np.array([[5.0, 5], [np.nan, np.nan]]).reshape(1, 2, 1, 2)], axis=2)
    # the second line is 1, ½, ½ or 0, and the width 4, 4½, 4½ or 5
    assert region(third, resamples=2, permutations=400, splits=1, seed=0).p_value == 1
    swapped = third[:, :, ::-1].copy()
    swapped[0, :, 1] = [[1, 1], [0, 0]]
    assert region(swapped, resamples=2, permutations=4_000, splits=1, seed=0).p_value == pytest.approx(1 / 4, abs=0.04)


def test_split_half_lines_are_scored_on_seeds_that_did_not_choose():
    # chosen on seed 1: 6, which is 6 again; chosen on seed 2: 10, which is 0 on seed 1
    scores = np.array([[[0.0, 10], [6, 6]], [[0, 10], [6, 6]]])[None]
    found = region(scores, resamples=2, permutations=1, splits=4_000, seed=0)
    assert found.split_lines == pytest.approx(np.full((1, 2), 3), abs=0.2)
    assert found.lines.tolist() == [[6, 6]]
    assert found.split_width == 0


def test_split_half_lines_have_no_luck_of_a_maximum():
    found = [region(noisy(1, 2, 6, 10, seed=seed), resamples=2, permutations=1, splits=50, seed=0) for seed in range(200)]
    assert np.mean([one.lines.mean() for one in found]) == pytest.approx(1.267 / np.sqrt(10), rel=0.1)  # E max of 6
    assert np.mean([one.split_lines.mean() for one in found]) == pytest.approx(0, abs=0.05)


def test_settings_are_arranged_by_x_line_and_the_rest():
    hypers = {"x": [2, 1, 1, 2, 1], "tau": [0.1, 0.1, 10.0, 10.0, 0.1], "n": [10, 10, 20, 20, 10], "kappa": [1, 1, 1, 1, 2]}
    panel = arrange(np.arange(10.0).reshape(5, 2), hypers, "x", "tau")
    assert (panel.x_values, panel.line_values) == ((1, 2), (0.1, 10.0))
    assert (panel.remaining_names, panel.remaining_values) == (("kappa",), ((1,), (2,)))  # n goes with tau
    assert panel.scores[..., 0].tolist()[0][0] == [2, 8]
    assert panel.scores[1, 0, 0].tolist() == [0, 1]
    assert np.isnan(panel.scores[1, 1, 1]).all()


def test_bad_requests_are_refused():
    hypers = {"x": [1, 2], "tau": [1, 2]}
    with pytest.raises(UserError, match='"ta" is not swept here; did you mean "tau"'):
        arrange(np.ones((2, 2)), hypers, "x", "ta")
    with pytest.raises(UserError, match="needs another hyperparameter"):
        arrange(np.ones((2, 2)), hypers, "x", "x")
    with pytest.raises(UserError, match='several values of "tau"'):
        arrange(np.ones((2, 2)), {"x": [1, 2], "tau": [1, 1]}, "x", "tau")
    with pytest.raises(UserError, match="several settings have x = 1, tau = 2"):
        arrange(np.ones((3, 2)), {"x": [1, 1, 2], "tau": [2, 2, 3]}, "x", "tau")
    partial = exact([[[1], [2]]])
    partial[0, 0, 0, 0] = np.nan
    with pytest.raises(UserError, match="1 of 2 settings lack some"):
        region(partial, seed=0)
    with pytest.raises(UserError, match="1 of 4 points have no setting"):
        region(exact([[[1], [2]], [[1], [np.nan]]]), seed=0)
    with pytest.raises(UserError, match="at least two lines"):
        region(exact([[[1]]]), seed=0)
    with pytest.raises(TooFewRunsError):
        region(exact([[[1], [2]]], seeds=1), seed=0)


@pytest.mark.slow
def test_without_an_effect_p_values_are_uniform():
    def p_value(seed: int) -> float:
        scores = noisy(3, 5, 3, 8, seed=seed, luck=2) + np.arange(3)[:, None]
        found: Region = region(scores, resamples=2, permutations=199, splits=1, seed=seed)
        return found.p_value

    p_values = np.array([p_value(seed) for seed in range(500)])
    assert stats.kstest(p_values - 0.5 / 200, "uniform").pvalue > 0.01
    assert np.mean(p_values <= 0.05) == pytest.approx(0.05, abs=0.03)
