"""Aggregates over tasks: small tables by hand, rliable and scipy on the same data."""

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.aggregates import (
    AGGREGATES,
    aggregate,
    aggregate_difference,
    improvement,
    interquartile_mean,
    probability_of_improvement,
)
from analysis.statistics.estimate import TooFewRunsError
from sweep.messages import UserError

TABLE = np.array([[1.0, 8.0, 3.0], [3.0, 6.0, 2.0]])  # [runs, tasks]: task means 2, 7, 2.5
SCORES = np.random.default_rng(0).normal(0.7, 0.5, size=(11, 7))


def value(scores, name):
    return aggregate(scores, name, resamples=10).value


def test_aggregates_of_a_small_table_are_those_worked_out_by_hand():
    assert value(TABLE, "mean") == pytest.approx(11.5 / 3)
    assert value(TABLE, "median") == 2.5
    # of 1 2 3 3 6 8 one is trimmed at each end: (2 + 3 + 3 + 6) / 4
    assert value(TABLE, "iqm") == 3.5
    # min(score, 1) of 0.5, 2, −1, 1 is 0.5, 1, −1, 1
    assert value(np.array([[0.5, -1.0], [2.0, 1.0]]), "optimality_gap") == pytest.approx(1 - 1.5 / 4)


@pytest.mark.parametrize("shape", [(11, 7), (3, 2), (2, 1), (30, 6), (5, 5)])
def test_aggregates_are_rliables(shape):
    from rliable import metrics

    scores = np.random.default_rng(1).normal(0.7, 0.5, size=shape)
    for name, theirs in [
        ("mean", metrics.aggregate_mean),
        ("median", metrics.aggregate_median),
        ("iqm", metrics.aggregate_iqm),
        ("optimality_gap", metrics.aggregate_optimality_gap),
    ]:
        assert value(scores, name) == pytest.approx(theirs(scores), rel=1e-12)


def test_tasks_count_the_same_whatever_their_number_of_runs():
    ragged = {"few": [0.0, 0.0], "many": [1.0] * 6}
    assert value(ragged, "mean") == value(ragged, "median") == value(ragged, "optimality_gap") == 0.5


def test_the_interquartile_mean_of_unequal_tasks_is_that_of_the_pool():
    tasks = [[5.0, 1.0, 9.0], [2.0, 4.0], [7.0, -3.0, 8.0, 0.5]]
    assert value(tasks, "iqm") == pytest.approx(stats.trim_mean(np.concatenate(tasks), 0.25))
    # several pools of different sizes at once
    padded = np.array([[[1.0, 2.0, 3.0, 90.0]], [[4.0, 8.0, np.nan, np.nan]]])
    assert interquartile_mean(padded).tolist() == [2.5, 6.0]


def test_probability_of_improvement_counts_pairs_and_halves_ties():
    # first task: of 4 pairs 2 > 1, 2 = 2, 3 > 1, 3 > 2 → 3.5 / 4; second task: none → 0
    first, second = np.array([[2.0, 0.0], [3.0, 1.0]]), np.array([[1.0, 5.0], [2.0, 6.0]])
    found = probability_of_improvement(first, second, resamples=100)
    assert found.value == pytest.approx((3.5 / 4 + 0) / 2)
    assert probability_of_improvement(second, first, resamples=100).value == pytest.approx(1 - found.value)


def test_probability_of_improvement_is_rliables_with_ties_and_unequal_numbers_of_runs():
    from rliable import metrics

    first, second = np.round(SCORES, 1), np.round(np.random.default_rng(2).normal(0.6, 0.5, (5, 7)), 1)
    mine = probability_of_improvement(first, second, resamples=10)
    assert mine.value == pytest.approx(metrics.probability_of_improvement(first, second))
    assert mine.num_runs == 5


def test_the_probability_of_improvement_leaves_out_runs_that_are_not_there():
    first, second = np.array([[1.0, 3.0, np.nan]]), np.array([[2.0, np.nan, np.nan]])
    assert improvement(first, second) == 0.5


def test_an_interval_of_one_task_is_that_of_the_percentile_bootstrap():
    runs = SCORES[:, :1]
    mine = aggregate(runs, "mean", resamples=40_000)
    means = np.random.default_rng(5).choice(runs[:, 0], (40_000, 11)).mean(1)
    low, high = np.quantile(means, [0.025, 0.975])
    assert (mine.low, mine.high) == pytest.approx((low, high), abs=0.03 * (high - low))


def test_paired_seeds_show_what_tasks_have_in_common():
    # a run's luck is the same on all tasks: the mean over 7 tasks varies as much as one of them
    luck = np.random.default_rng(3).normal(size=(20, 1)) + np.zeros(7)
    alone, together = aggregate(luck, "mean"), aggregate(luck, "mean", paired=True)
    ratio = (together.high - together.low) / (alone.high - alone.low)
    assert ratio == pytest.approx(np.sqrt(7), rel=0.1)
    assert (alone.method, together.method) == ("stratified bootstrap", "stratified bootstrap, paired seeds")


def test_paired_seeds_cancel_in_a_difference():
    first = SCORES + 0.1
    found = aggregate_difference(first, SCORES, paired=True)
    assert (found.value, found.low, found.high) == pytest.approx((0.1, 0.1, 0.1))
    apart = aggregate_difference(first, SCORES)
    assert apart.low < 0 < apart.high


def test_resampled_tasks_show_how_much_depends_on_them():
    scores = np.arange(7.0) + np.random.default_rng(3).normal(0, 0.01, (5, 7))
    fixed, drawn = aggregate(scores, "mean"), aggregate(scores, "mean", tasks=True)
    # the standard deviation of 0 … 6 is 2, so that of the mean of seven draws is 2/√7 = 0.76
    assert fixed.high - fixed.low < 0.02
    assert drawn.high - drawn.low == pytest.approx(2 * 1.96 * 2 / np.sqrt(7), rel=0.1)


def test_equal_scores_have_an_interval_without_width():
    for name in AGGREGATES:
        found = aggregate(np.full((3, 4), 0.1), name)
        assert found.value == found.low == found.high
    found = probability_of_improvement(np.ones((3, 4)), np.ones((3, 4)))
    assert found.value == found.low == found.high == 0.5


def test_an_estimate_carries_what_it_was_made_with():
    found = aggregate([SCORES[:, 0], SCORES[:4, 1]], "median", confidence=0.9, resamples=77, seed=5)
    assert (found.num_runs, found.confidence, found.resamples, found.seed) == (4, 0.9, 77, 5)
    assert found == aggregate([SCORES[:, 0], SCORES[:4, 1]], "median", confidence=0.9, resamples=77, seed=5)
    assert found != aggregate([SCORES[:, 0], SCORES[:4, 1]], "median", confidence=0.9, resamples=77, seed=6)


def test_tasks_of_two_algorithms_are_matched_by_name():
    first, second = {"a": [1.0, 1.0], "b": [3.5, 3.5]}, {"b": [4.0, 4.0], "a": [3.0, 3.0]}
    assert probability_of_improvement(first, second).value == 0
    with pytest.raises(UserError, match="only one of the two has scores on c"):
        probability_of_improvement(first, {**second, "c": [1.0, 2.0]})


def test_what_has_no_aggregate_is_refused():
    with pytest.raises(UserError, match=r'unknown aggregate "igm"; did you mean "iqm"\?'):
        aggregate(SCORES, "igm")
    with pytest.raises(TooFewRunsError):
        aggregate(SCORES[:1], "iqm")
    with pytest.raises(UserError, match="1 of 77 scores is NaN"):
        aggregate(np.where(SCORES[2, 2] == SCORES, np.nan, SCORES))
    with pytest.raises(UserError, match="`sample_efficiency` takes several"):
        aggregate(np.zeros((3, 2, 4)))
    with pytest.raises(UserError, match="confidence: 1 is not"):
        aggregate(SCORES, confidence=1)
