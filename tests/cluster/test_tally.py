"""Numbers of a launch under way, against times and rates worked out by hand."""

import pytest

from agents.hypers import GreedyACHypers, SACHypers
from cluster.tally import Tally
from sweep.shards import Shard
from sweep.trials import Trial


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def shard(agent, count, steps=100):
    hypers = {"SAC": SACHypers, "GreedyAC": GreedyACHypers}[agent]()
    return Shard(tuple(Trial(agent, "Pendulum-CA", hypers, seed, steps, 1000, 0.99) for seed in range(count)))


def test_rates_and_times_follow_from_what_is_done_under_way_and_waiting():
    clock = Clock()
    first, second, third = shard("SAC", 4), shard("GreedyAC", 2), shard("GreedyAC", 4, steps=300)
    tally = Tally.of("study", "tune", [first, second, third], clock)
    assert (tally.total.trials, tally.total.steps) == (10, 400 + 200 + 1200)
    tally.read({first: 0}, [second, third])
    assert tally.total.left is None
    clock.now = 10.0
    tally.read({first: 200, second: 100}, [third])
    sac, greedy = tally.rows.values()
    assert tally.rate == 30.0
    assert sac.left == pytest.approx((200 + 100) / 30)  # both under way share the rate: it may take until both are done
    assert greedy.left == pytest.approx((200 + 100 + 1200) / 30)
    assert (sac.share, greedy.running, tally.total.left) == (0.5, 2, greedy.left)
    tally.finished(first.trials, here=True)
    clock.now = 20.0
    tally.read({second: 200, third: 0}, [])
    assert (sac.done, sac.share, sac.left, sac.running) == (4, 1.0, 0.0, 0)
    assert tally.rate == 30.0


def test_what_others_trained_counts_as_done_but_not_as_our_speed():
    clock = Clock()
    members = shard("SAC", 4)
    tally = Tally.of("study", "tune", [members], clock)
    tally.finished(members.trials[:2], here=False)
    clock.now = 10.0
    tally.read({Shard(members.trials[2:]): 50}, [])
    assert (tally.rate, tally.total.done, tally.total.done_steps) == (5.0, 2, 250)


def test_nobody_waits_for_trials_that_failed():
    clock = Clock()
    members = shard("SAC", 4)
    tally = Tally.of("study", "tune", [members], clock)
    tally.failed(members.trials[:1])
    clock.now = 10.0
    tally.read({Shard(members.trials[1:]): 150}, [])
    assert (tally.total.failed, tally.total.steps, tally.total.share, tally.total.left) == (1, 300, 0.5, 10.0)


def test_a_worker_that_begins_again_does_not_make_the_rate_negative():
    clock = Clock()
    members = shard("SAC", 4)
    tally = Tally.of("study", "tune", [members], clock)
    for now, steps in ((10.0, 300), (20.0, 10), (30.0, 110)):
        clock.now = now
        tally.read({members: steps}, [])
        assert tally.rate >= 0.0
    assert tally.rate == pytest.approx(110 / 30)  # since the beginning, the one reading that is not higher


def test_the_rate_is_that_of_the_last_half_minute():
    clock = Clock()
    members = shard("SAC", 4, steps=10_000)
    tally = Tally.of("study", "tune", [members], clock)
    for second in range(1, 101):
        clock.now = float(second)
        tally.read({members: 10 * second if second <= 50 else 500 + 100 * (second - 50)}, [])
    assert tally.rate == pytest.approx(100.0)


def test_as_json_it_has_the_counts_by_agent_and_environment():
    tally = Tally.of("study", "evaluate", [shard("SAC", 3)], Clock())
    found = tally.to_json()
    assert (found["stage"], found["planned"], found["agent_steps"], found["eta_seconds"]) == ("evaluate", 3, 300, None)
    (group,) = found["groups"]
    assert (group["agent"], group["environment"], group["planned"], group["running"]) == ("SAC", "Pendulum-CA", 3, 0)
