"""Resamples: how many runs, in which pieces, and the same again for the same seed."""

import numpy as np
import pytest

from analysis.statistics import bootstrap
from analysis.statistics.bootstrap import chunk_sizes, draw_weights, percentile_ends


def test_weights_are_those_of_draws_with_replacement():
    weights = draw_weights(5, 20_000, seed=0)
    counts = np.rint(weights * 5)
    assert np.allclose(weights * 5, counts) and np.all(counts.sum(1) == 5)
    # a run is in a resample k times with the probability of Binomial(5, 1/5): 0.328 for none, 0.410 for once
    assert np.mean(counts == 0) == pytest.approx(0.8**5, abs=0.01)
    assert np.mean(counts == 1) == pytest.approx(0.8**4, abs=0.01)
    assert counts.mean(0) == pytest.approx(np.ones(5), abs=0.03)


def test_weights_do_not_depend_on_chunks_of_rows_going_wrong(monkeypatch):
    monkeypatch.setattr(bootstrap, "_CHUNK_BYTES", 8 * 5 * 3)  # three resamples at a time, the last one alone
    weights = draw_weights(5, 10, seed=0)
    assert np.all(np.rint(weights * 5).sum(1) == 5)
    assert np.array_equal(weights, draw_weights(5, 10, seed=0))
    assert not np.array_equal(weights, draw_weights(5, 10, seed=1))


def test_chunks_add_up_and_stay_within_32_mebibytes():
    sizes = list(chunk_sizes(10_000, 1_000_000))
    assert sum(sizes) == 10_000 and max(sizes) * 8 * 1_000_000 <= 32 << 20
    assert list(chunk_sizes(7, 10**9)) == [1] * 7
    assert list(chunk_sizes(7, 1)) == [7]


def test_the_percentile_interval_leaves_out_the_same_share_at_either_end():
    low, high = percentile_ends(np.stack([np.arange(101.0), np.arange(101.0)[::-1] + 5]), 0.9)
    assert low == pytest.approx([5, 10]) and high == pytest.approx([95, 100])
