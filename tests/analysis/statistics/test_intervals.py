"""Intervals of a mean: numbers by hand, scipy, and what is refused."""

import math

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.intervals import METHODS, caution, interval, interval_ends, one_error_confidence
from sweep.messages import UserError

RUNS = [4.0, 8.0, 6.0, 5.0, 3.0, 7.0, 1.0, 12.0]  # mean 5.75, variance 79.5 / 7


def test_a_student_interval_is_that_of_the_printed_table():
    # of 1, 2, 3 the mean is 2 and the standard error 1/√3; t(0.975, 2) = 4.303
    found = interval([1.0, 2.0, 3.0])
    assert (found.value, found.method, found.num_runs, found.resamples, found.seed) == (2.0, "Student", 3, None, None)
    assert found.low == pytest.approx(2 - 4.303 / math.sqrt(3), abs=1e-3)
    assert found.high == pytest.approx(2 + 4.303 / math.sqrt(3), abs=1e-3)


def test_two_runs_have_an_interval_twelve_standard_errors_wide_at_either_side():
    found = interval([0.0, 2.0])  # standard error 1
    assert (found.low, found.high) == pytest.approx((1 - 12.706, 1 + 12.706), abs=1e-3)


def test_a_standard_error_band_states_what_it_covers_on_normal_data():
    found = interval(RUNS, "standard_error")
    assert found.high - found.value == pytest.approx(math.sqrt(79.5 / 7 / 8))
    assert found.method == "±1 standard error"
    # P(|T₂| < 1) = 1/√3, in closed form
    assert interval([1, 2, 3], "standard_error").confidence == one_error_confidence(3) == pytest.approx(1 / math.sqrt(3))
    assert one_error_confidence(100_000) == pytest.approx(0.6827, abs=1e-4)


def test_a_percentile_bootstrap_of_two_runs_ends_at_the_runs():
    # a mean of two draws is 0, 1 or 2 with probability ¼, ½, ¼: the quantiles 0.025 and 0.975 are 0 and 2, 0.3 and 0.7 are 1
    found = interval([0.0, 2.0], "percentile")
    assert (found.value, found.low, found.high) == (1.0, 0.0, 2.0)
    found = interval([0.0, 2.0], "percentile", confidence=0.4)
    assert (found.low, found.high) == (1.0, 1.0)


def test_a_percentile_interval_is_that_of_all_resamples():
    values = np.array([0.0, 1.0, 4.0, 9.0])
    everything = values[np.stack(np.meshgrid(*[range(4)] * 4), -1).reshape(-1, 4)].mean(1)  # all 256 of them
    found = interval(values, "percentile", confidence=0.8, resamples=50_000)
    assert [found.low, found.high] == pytest.approx(np.quantile(everything, [0.1, 0.9]), abs=0.26)
    assert found.confidence == 0.8


def test_bca_is_efrons_formula():
    runs = np.array(RUNS) ** 2
    found = interval(runs, "bca", resamples=200_000, seed=5)
    means = np.random.default_rng(9).choice(runs, (200_000, len(runs))).mean(1)
    bias = stats.norm.ppf(np.mean(means < runs.mean()) + np.mean(means == runs.mean()) / 2)
    left_out = (runs.sum() - runs) / (len(runs) - 1)
    toward = left_out.mean() - left_out
    acceleration = (toward**3).sum() / (6 * (toward**2).sum() ** 1.5)
    normal = np.array([stats.norm.ppf(0.025), stats.norm.ppf(0.975)])
    levels = stats.norm.cdf(bias + (bias + normal) / (1 - acceleration * (bias + normal)))
    assert [found.low, found.high] == pytest.approx(np.quantile(means, levels), rel=0.01)
    # runs with a long tail upwards: both ends are higher than those of the percentile bootstrap
    plain = interval(runs, "percentile")
    assert found.low > plain.low + 1 and found.high > plain.high + 1


def test_another_statistic_is_bootstrapped_along_its_axis():
    found = interval(RUNS, "percentile", statistic=np.median, seed=3)
    medians = np.median(np.random.default_rng(4).choice(RUNS, (100_000, 8)), axis=1)
    assert found.value == 5.5
    assert [found.low, found.high] == pytest.approx(np.quantile(medians, [0.025, 0.975]), abs=0.5)


@pytest.mark.parametrize("method", ["student", "standard_error"])
def test_only_a_bootstrap_has_an_interval_of_a_median(method):
    with pytest.raises(UserError, match='is for the mean; choose "percentile" or "bca"'):
        interval(RUNS, method, statistic=np.median)


@pytest.mark.parametrize("method", ["percentile", "bca"])
def test_the_same_seed_gives_the_same_interval_and_another_seed_another(method):
    first, again, other = (interval(np.sqrt(RUNS), method, seed=seed) for seed in (1, 1, 2))
    assert first == again
    assert (first.low, first.high) != (other.low, other.high)
    assert (first.seed, first.resamples, first.value) == (1, 10_000, other.value)


@pytest.mark.parametrize("method", METHODS)
def test_equal_runs_have_an_interval_without_width(method):
    # the rounded mean of three times 0.1 is not 0.1
    found = interval([0.1, 0.1, 0.1], method)
    assert (found.value, found.low, found.high) == (0.1, 0.1, 0.1)


def test_a_wider_level_gives_a_wider_interval():
    for method in ("student", "percentile", "bca"):
        narrow, wide = interval(RUNS, method, confidence=0.8), interval(RUNS, method, confidence=0.99)
        assert wide.low < narrow.low < narrow.value < narrow.high < wide.high


def test_many_samples_at_once_have_the_intervals_of_each_alone():
    samples = np.random.default_rng(0).normal(size=(3, 2, 7))
    samples[1, 0] = 4
    for method in METHODS:
        low, high = interval_ends(samples, method, seed=2)
        for place in np.ndindex(3, 2):
            alone = interval(samples[place], method, seed=2)
            assert (low[place], high[place]) == pytest.approx((alone.low, alone.high), rel=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_one_run_has_no_interval(method):
    with pytest.raises(TooFewRunsError, match="interval needs at least 2 runs, and there is 1 run"):
        interval([1.0], method)
    with pytest.raises(TooFewRunsError, match="there are 0 runs"):
        interval([], method)


def test_runs_without_a_number_are_counted_and_refused():
    with pytest.raises(UserError, match="2 of 4 scores are NaN or infinite; decide first what a diverged run counts for"):
        interval([1.0, math.nan, 2.0, math.inf])


def test_an_unknown_method_is_answered_with_the_nearest():
    with pytest.raises(UserError, match=r'unknown method "precentile"; did you mean "percentile"\?'):
        interval(RUNS, "precentile")


@pytest.mark.parametrize(("given", "said"), [({"confidence": 95}, "confidence: 95 is not"), ({"resamples": 0}, "resamples: 0")])
def test_levels_and_numbers_of_resamples_have_a_range(given, said):
    with pytest.raises(UserError, match=said):
        interval(RUNS, **given)


def test_a_table_of_runs_is_no_sample():
    with pytest.raises(UserError, match="an array of 1 axis is needed, this one has 2"):
        interval(np.zeros((3, 3)))


def test_bca_is_refused_where_it_is_undefined():
    # the median of these does not change when any one run is left out
    with pytest.raises(UserError, match='"bca" is undefined here'):
        interval([0.0, 5.0, 5.0, 5.0, 5.0, 9.0], "bca", statistic=np.median)


def test_a_reader_is_warned_of_fewer_than_ten_runs():
    assert "8 runs only: a BCa bootstrap interval of so few covers less than the 95% it states" in str(
        caution(interval(RUNS, "bca"))
    )
    assert "too short where some collapse" in str(caution(interval(RUNS)))
    assert caution(interval(range(10))) is None
