"""Bands around curves: point for point the intervals, whole runs together, and all points at once."""

import numpy as np
import pytest
from scipy import stats

from analysis.statistics import bootstrap
from analysis.statistics.bands import BAND_METHODS, band, simultaneous_band
from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.intervals import interval
from sweep.messages import UserError

CURVES = np.random.default_rng(0).normal(size=(12, 40)).cumsum(1)


@pytest.mark.parametrize("method", ["student", "standard_error"])
def test_each_point_has_its_interval(method):
    found = band(CURVES, method, confidence=0.9)
    for point in (0, 17, 39):
        alone = interval(CURVES[:, point], method, confidence=0.9)
        assert (found.value[point], found.low[point], found.high[point]) == pytest.approx((alone.value, alone.low, alone.high))
        assert (found.confidence, found.method, found.num_runs) == (alone.confidence, alone.method, 12)
    assert not found.simultaneous


def test_a_bootstrap_band_has_at_each_point_the_percentile_interval():
    found = band(CURVES, "percentile", resamples=40_000)
    for point in (0, 39):
        alone = interval(CURVES[:, point], "percentile", resamples=40_000, seed=8)
        width = alone.high - alone.low
        assert (found.low[point], found.high[point]) == pytest.approx((alone.low, alone.high), abs=0.03 * width)
    assert (found.resamples, found.seed) == (40_000, 0)


def test_whole_runs_are_resampled():
    # two points of opposite sign: the sum of the curves is 0 in every resample, and so one end mirrors the other exactly
    found = band(np.stack([CURVES[:, 0], -CURVES[:, 0]], axis=1), "percentile")
    assert found.low[0] == pytest.approx(-found.high[1], abs=1e-12)


def test_chunks_of_points_are_drawn_with_the_same_resamples(monkeypatch):
    whole, largest = band(CURVES, "percentile", resamples=500), simultaneous_band(CURVES, resamples=500)
    monkeypatch.setattr(bootstrap, "_CHUNK_BYTES", 8 * 500 * 7)
    np.testing.assert_allclose(band(CURVES, "percentile", resamples=500).low, whole.low, rtol=1e-12)
    np.testing.assert_allclose(simultaneous_band(CURVES, resamples=500).low, largest.low, rtol=1e-12)


@pytest.mark.parametrize("method", [*BAND_METHODS, "simultaneous"])
def test_where_all_runs_are_equal_a_band_has_no_width(method):
    curves = CURVES.copy()
    curves[:, 5] = 0.1
    found = simultaneous_band(curves) if method == "simultaneous" else band(curves, method)
    assert found.value[5] == found.low[5] == found.high[5] == 0.1
    assert np.all(np.delete(found.low < found.high, 5))


def test_a_simultaneous_band_at_one_point_is_students():
    found, student = simultaneous_band(CURVES[:, :1]), band(CURVES[:, :1])
    assert found.low == pytest.approx(student.low) and found.high == pytest.approx(student.high)
    assert found.simultaneous


def test_a_simultaneous_band_of_independent_points_is_as_wide_as_that_of_many_normal_maxima():
    # 300 runs, 20 independent points: the largest of 20 |normal| numbers is below z with (2Φ(z) − 1)^20 = 0.95
    curves = np.random.default_rng(1).normal(size=(300, 20))
    found = simultaneous_band(curves)
    times = (found.high - found.value) / (curves.std(0, ddof=1) / np.sqrt(300))
    assert times == pytest.approx(times[0])
    assert times[0] == pytest.approx(stats.norm.ppf((1 + 0.95 ** (1 / 20)) / 2), abs=0.08)


def test_a_simultaneous_band_of_few_runs_allows_for_their_estimated_deviation():
    # deviations of the two points have nothing in common: z with (2Φ(z) − 1)² = 0.95, and Student's quantile at its level
    curves = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [0.0, 0.0]])
    found = simultaneous_band(curves, resamples=200_000)
    level = stats.norm.sf(stats.norm.ppf((1 + 0.95 ** (1 / 2)) / 2))
    assert found.high / np.sqrt(0.5 / 5) == pytest.approx(stats.t.isf(level, 4), rel=0.01)


def test_a_simultaneous_band_of_copies_is_that_of_one_point():
    one = simultaneous_band(CURVES[:, :1], confidence=0.9)
    many = simultaneous_band(np.repeat(CURVES[:, :1], 30, axis=1), confidence=0.9)
    assert many.high[7] == pytest.approx(one.high[0])


def test_the_same_seed_gives_the_same_band():
    for make in (lambda seed: band(CURVES, "percentile", seed=seed), lambda seed: simultaneous_band(CURVES, 0.99, seed=seed)):
        assert np.array_equal(make(3).low, make(3).low)
        assert not np.array_equal(make(3).low, make(4).low)


def test_what_has_no_band_is_refused():
    with pytest.raises(TooFewRunsError, match="a band needs at least 2 runs, and there is 1 run"):
        band(CURVES[:1])
    with pytest.raises(TooFewRunsError):
        simultaneous_band(CURVES[:1])
    with pytest.raises(UserError, match=r'unknown method "studnet"; did you mean "student"\?'):
        band(CURVES, "studnet")
    with pytest.raises(UserError, match="1 of 480 scores is NaN"):
        band(np.where(CURVES[3, 3] == CURVES, np.nan, CURVES))
    with pytest.raises(UserError, match="an array of 2 axes is needed, this one has 1"):
        band(CURVES[0])
