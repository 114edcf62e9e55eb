import numpy as np
import pytest

from agents.function import train_function

CONFIG = {"steps": 10}


def records(*episodes):
    def function(config, seed, report):
        for episode in episodes:
            report(*episode)

    return train_function(function, CONFIG, 0)


def test_reported_episodes_become_records_and_the_rest_an_unfinished_episode():
    r = records((5.0, 3), (-1.0, 4, False))
    assert r.episode.tolist() == [0, 1, 2]
    assert r.first_step.tolist() == [1, 4, 8]
    assert r.length.tolist() == [3, 4, 3]
    assert r.ending.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(r.episodic_return, [5, -1, np.nan])
    assert r.diverged_at.tolist() == [0]


def test_a_return_that_is_not_finite_marks_the_trial_as_diverged_from_there_on():
    r = records((1.0, 2), (np.inf, 3), (2.0, 5))
    assert r.diverged_at.tolist() == [5]
    np.testing.assert_array_equal(r.episodic_return, [1, np.nan, np.nan])


@pytest.mark.parametrize("episodes", [[(1.0, 11)], [(1.0, 6), (1.0, 5)], [(1.0, 0)]])
def test_more_steps_than_there_are_and_empty_episodes_are_refused(episodes):
    with pytest.raises(ValueError, match="reported an episode of"):
        records(*episodes)


def test_the_function_is_told_everything():
    told = []
    train_function(lambda config, seed, report: told.append((config, seed)), {"steps": 10, "lr": 0.1}, 7)
    assert told == [({"steps": 10, "lr": 0.1}, 7)]
