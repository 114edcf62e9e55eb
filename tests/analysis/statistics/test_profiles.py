"""Performance profiles and sample efficiency: a small table by hand, and bands that behave."""

import numpy as np
import pytest

from analysis.statistics.aggregates import aggregate
from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.profiles import performance_profile, sample_efficiency
from sweep.messages import UserError

TABLE = np.array([[0.0, 2.0], [1.0, 4.0]])  # [runs, tasks]: task means 0.5 and 3
SCORES = np.random.default_rng(0).normal(0.5, 0.4, size=(9, 4, 5))  # [runs, tasks, checkpoints]


def test_a_profile_is_the_share_of_scores_strictly_above_each_threshold():
    found = performance_profile(TABLE, [-1, 0, 0.5, 1, 2, 3, 4])
    assert found.value.tolist() == [1, 0.75, 0.75, 0.5, 0.25, 0.25, 0]
    assert (found.num_runs, found.method, found.simultaneous) == (2, "stratified bootstrap", False)


def test_a_profile_of_task_means_is_the_share_of_tasks():
    assert performance_profile(TABLE, [-1, 0, 0.5, 1, 3], of="task_means").value.tolist() == [1, 1, 0.5, 0.5, 0]


def test_a_task_with_more_runs_counts_no_more():
    found = performance_profile({"few": [0.0, 0.0], "many": [2.0] * 10}, [1.0])
    assert found.value.tolist() == [0.5]


def test_the_band_of_a_profile_is_binomial_where_one_task_is():
    # with 40 of 100 runs above, resampled shares are Binomial(100, 0.4) / 100: 0.31 to 0.50 for 95 %
    runs = np.repeat([1.0, 0.0], [40, 60])[:, None]
    found = performance_profile(runs, [0.5], resamples=20_000)
    assert (found.value[0], found.low[0], found.high[0]) == pytest.approx((0.4, 0.31, 0.5), abs=0.011)


def test_a_profile_has_no_width_where_all_scores_are_above():
    found = performance_profile(TABLE, [-1.0, 9.0])
    assert found.low.tolist() == found.high.tolist() == [1, 0]


def test_sample_efficiency_is_the_aggregate_at_each_checkpoint():
    for name in ("iqm", "median"):
        found = sample_efficiency(SCORES, name, resamples=20_000)
        for checkpoint in range(5):
            alone = aggregate(SCORES[:, :, checkpoint], name, resamples=20_000, seed=3)
            width = alone.high - alone.low
            assert found.value[checkpoint] == alone.value
            assert found.low[checkpoint] == pytest.approx(alone.low, abs=0.05 * width)
            assert found.high[checkpoint] == pytest.approx(alone.high, abs=0.05 * width)


def test_sample_efficiency_takes_tasks_with_different_numbers_of_runs():
    found = sample_efficiency([SCORES[:, 0], SCORES[:3, 1]], "mean")
    assert found.value == pytest.approx((SCORES[:, 0].mean(0) + SCORES[:3, 1].mean(0)) / 2)
    assert found.num_runs == 3


def test_a_curve_carries_what_it_was_made_with_and_the_same_seed_gives_the_same():
    found = sample_efficiency(SCORES, paired=True, tasks=True, confidence=0.8, resamples=50, seed=2)
    assert (found.method, found.confidence, found.resamples, found.seed) == (
        "stratified bootstrap, paired seeds, tasks resampled",
        0.8,
        50,
        2,
    )
    again, other = (sample_efficiency(SCORES, paired=True, tasks=True, confidence=0.8, resamples=50, seed=s) for s in (2, 3))
    assert np.array_equal(found.low, again.low) and not np.array_equal(found.low, other.low)


def test_what_has_no_profile_is_refused():
    with pytest.raises(UserError, match=r'unknown kind of profile "task_mean"; did you mean "task_means"\?'):
        performance_profile(TABLE, [0.0], of="task_mean")
    with pytest.raises(UserError, match="one checkpoint"):
        performance_profile(SCORES, [0.0])
    with pytest.raises(UserError, match="thresholds: 1 of 2 scores is NaN"):
        performance_profile(TABLE, [0.0, np.nan])
    with pytest.raises(TooFewRunsError):
        sample_efficiency(SCORES[:1])
    with pytest.raises(UserError, match="confidence: 0 is not"):
        performance_profile(TABLE, [0.0], confidence=0)
