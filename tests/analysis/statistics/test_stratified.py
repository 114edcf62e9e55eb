"""The stratified bootstrap: which runs, seeds and tasks make up a resample."""

import numpy as np
import pytest

from analysis.statistics import bootstrap
from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.stratified import describe, resample, take_tasks
from sweep.messages import UserError

# a score says where it is from: 100 · task + run
LABELED = 100.0 * np.arange(4) + np.arange(6)[:, None]


def draw(groups, resamples=2_000, **how):
    """[groups][resamples, tasks, runs], of scores without checkpoints."""
    chunks = list(resample([take_tasks(group, "test") for group in groups], resamples, 0, **how))
    return [np.concatenate([chunk[number][0] for chunk in chunks]) for number in range(len(groups))]


def test_runs_are_resampled_within_their_task_and_independently_between_tasks():
    (drawn,) = draw([LABELED])
    assert drawn.shape == (2_000, 4, 6)
    assert np.all(drawn // 100 == np.arange(4)[:, None])
    runs = drawn % 100
    assert np.mean(runs[:, 0] == runs[:, 1]) == pytest.approx(1 / 6, abs=0.02)
    for run in range(6):
        assert np.mean(runs == run) == pytest.approx(1 / 6, abs=0.01)


def test_tasks_may_have_different_numbers_of_runs():
    (drawn,) = draw([[[0.0, 1.0], [100.0, 101.0, 102.0, 103.0]]])
    assert np.isnan(drawn[:, 0, 2:]).all() and not np.isnan(drawn[:, 1]).any()
    assert set(np.unique(drawn[:, 0, :2])) == {0, 1}
    assert np.mean(drawn[:, 1] == 103) == pytest.approx(1 / 4, abs=0.02)


def test_paired_seeds_are_the_same_in_all_tasks_and_all_algorithms():
    first, second = draw([LABELED, LABELED + 0.5], paired=True)
    assert np.all(first % 100 == first[:, :1] % 100)
    assert np.array_equal(first + 0.5, second)


def test_without_pairing_two_algorithms_have_their_own_runs():
    first, second = draw([LABELED, LABELED])
    assert np.mean(first == second) == pytest.approx(1 / 6, abs=0.02)


def test_two_algorithms_may_have_different_numbers_of_runs():
    first, second = draw([LABELED, LABELED[:2]])
    assert first.shape[2] == 6 and second.shape[2] == 2


def test_resampled_tasks_are_the_same_for_two_algorithms_and_keep_their_number_of_runs():
    ragged = [[0.0, 1.0], [100.0, 101.0, 102.0], [200.0, 201.0]]
    first, second = draw([ragged, ragged], tasks=True)
    tasks = np.nanmin(first // 100, axis=2)
    assert np.array_equal(tasks, np.nanmin(second // 100, axis=2))
    assert np.array_equal(tasks, np.nanmax(first // 100, axis=2))
    assert np.array_equal((~np.isnan(first)).sum(2), np.where(tasks == 1, 3, 2))
    assert np.mean(tasks == 2) == pytest.approx(1 / 3, abs=0.03)
    # the same task drawn twice has runs drawn anew
    twice = tasks[:, 0] == tasks[:, 1]
    assert not np.array_equal(first[twice, 0], first[twice, 1], equal_nan=True)


def test_a_run_is_the_same_one_at_every_checkpoint():
    scores = np.stack([LABELED, LABELED + 1_000], axis=2)
    for (drawn,) in resample([take_tasks(scores, "test")], 50, 0):
        assert drawn.shape == (2, 50, 4, 6)
        assert np.array_equal(drawn[0] + 1_000, drawn[1])


def test_arrays_lists_and_dicts_hold_the_same_scores():
    columns = list(LABELED.T)
    for other in (columns, dict(zip("abcd", columns, strict=True))):
        assert np.array_equal(take_tasks(other, "test").values, take_tasks(LABELED, "test").values)
    assert take_tasks(LABELED, "test").num_runs.tolist() == [6, 6, 6, 6]


def test_small_chunks_make_up_the_same_number_of_resamples(monkeypatch):
    monkeypatch.setattr(bootstrap, "_CHUNK_BYTES", 8 * 24 * 7)
    chunks = list(resample([take_tasks(LABELED, "test")], 20, 0))
    assert [chunk[0].shape[1] for chunk in chunks] == [7, 7, 6]


def test_the_same_seed_draws_the_same():
    first, again = (next(resample([take_tasks(LABELED, "test")], 9, 3))[0] for _ in range(2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, next(resample([take_tasks(LABELED, "test")], 9, 4))[0])


@pytest.mark.parametrize(
    ("scores", "said"),
    [
        ([], "there is no task"),
        ({"Pendulum-CA": [1.0, np.nan]}, "test, Pendulum-CA: 1 of 2 scores is NaN"),
        ([np.zeros((3, 2)), np.zeros((3, 4))], "different numbers of checkpoints"),
        (np.zeros(3), "an array of 2 or 3 axes is needed, this one has 1"),
    ],
)
def test_scores_that_make_no_sense_are_refused(scores, said):
    with pytest.raises(UserError, match=said):
        take_tasks(scores, "test")


def test_a_task_with_one_run_is_refused_by_name():
    with pytest.raises(TooFewRunsError, match="test, Acrobot-CA needs at least 2 runs, and there is 1 run"):
        take_tasks({"Pendulum-CA": [1.0, 2.0], "Acrobot-CA": [1.0]}, "test")


def test_seeds_that_differ_in_number_cannot_be_paired():
    with pytest.raises(UserError, match="paired seeds: every task needs the same number of runs, and there are 2, 6"):
        draw([LABELED, LABELED[:2]], paired=True)
    with pytest.raises(UserError, match="paired seeds"):
        draw([[[0.0, 1.0], [1.0, 2.0, 3.0]]], paired=True)
    with pytest.raises(UserError, match="compared on the same tasks"):
        draw([LABELED, LABELED[:, :3]])


def test_the_name_of_the_bootstrap_says_what_was_resampled():
    assert describe(False, False) == "stratified bootstrap"
    assert describe(True, True) == "stratified bootstrap, paired seeds, tasks resampled"
