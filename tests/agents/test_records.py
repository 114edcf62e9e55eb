import numpy as np
import pytest
import torch

from agents import records as module
from agents.records import ENDINGS, Recorder


def record(rewards, endings, finite=None):
    """Feed [T, P] lists; endings are ' ', 't' (terminated) or 'c' (cutoff)."""
    recorder = Recorder(len(rewards[0]), torch.device("cpu"))
    for t, row in enumerate(rewards):
        terminated = torch.tensor([e == "t" for e in endings[t]])
        truncated = torch.tensor([e == "c" for e in endings[t]])
        good = torch.tensor(finite[t]) if finite else torch.ones(len(row), dtype=torch.bool)
        recorder.add(torch.tensor(row, dtype=torch.float64), terminated, truncated, good)
    return recorder.finish()


@pytest.mark.parametrize("block", [1, 2, 3, 5, 100])
def test_episodes_are_cut_where_they_end_whatever_the_block_size(block, monkeypatch):
    monkeypatch.setattr(module, "_BLOCK_STEPS", block)
    r = record([[1, 10], [2, 20], [3, 30], [4, 40], [5, 50]], ["  ", "t ", "c ", " t", "  "])
    assert r.agent.tolist() == [0, 0, 0, 1, 1]
    assert r.episode.tolist() == [0, 1, 2, 0, 1]
    assert r.first_step.tolist() == [1, 3, 4, 1, 5]
    assert r.length.tolist() == [2, 1, 2, 4, 1]
    assert r.episodic_return.tolist() == [3, 3, 9, 100, 50]
    assert [ENDINGS[code] for code in r.ending] == ["terminated", "truncated", "budget", "terminated", "budget"]
    assert r.diverged_at.tolist() == [0, 0]


def test_an_episode_that_ends_with_the_last_step_leaves_no_empty_one():
    r = record([[1], [1]], [" ", "c"])
    assert r.length.tolist() == [2]
    assert [ENDINGS[code] for code in r.ending] == ["truncated"]


@pytest.mark.parametrize("block", [1, 3, 100])
def test_returns_are_nan_from_the_episode_of_the_divergence_on(block, monkeypatch):
    monkeypatch.setattr(module, "_BLOCK_STEPS", block)
    finite = [[True, True]] * 3 + [[False, True]] + [[True, True]] * 2
    r = record([[1, 1]] * 6, ["  ", "tt", "  ", "tt", "  ", "tt"], finite)
    assert r.diverged_at.tolist() == [4, 0]
    np.testing.assert_array_equal(r.episodic_return, [2, np.nan, np.nan, 2, 2, 2])
