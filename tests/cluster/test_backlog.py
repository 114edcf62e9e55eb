"""Shards that fail are taken apart until the trials that fail are alone; what other launches train is left to them."""

import pytest

from agents.hypers import SACHypers
from cluster import backlog
from cluster.backlog import MOST_ALIKE, Backlog
from cluster.worker import Receipt
from sweep.shards import Shard
from sweep.shards import pack as packing
from sweep.trials import Trial


def trials(count, steps=10, first=0):
    return [Trial("SAC", "Pendulum-CA", SACHypers(), seed, steps, 1000, 0.99) for seed in range(first, first + count)]


class World:
    """A store and other launches, as a backlog sees them."""

    def __init__(self):
        self.finished, self.claimed = set(), set()

    def backlog(self, *shards):
        def pack(members):
            return packing(members, slots=1)

        return Backlog([Shard(tuple(shard)) for shard in shards], lambda: self.finished, lambda: self.claimed, pack)


@pytest.fixture(autouse=True)
def _always_looks(monkeypatch):
    monkeypatch.setattr(backlog, "_LOOK_SECONDS", 0.0)


def train(pending, fails, message="ValueError: bad"):
    """Train all that is pending; a shard with a trial that fails fails whole. Return finished, given up, and the shards."""
    done, given_up, tried = [], [], []
    while pending:
        shard = pending.next()
        tried.append(shard)
        if any(trial in fails for trial in shard.trials):
            failed = pending.failed(Receipt(shard, "here", error=f"Traceback …\n{message} {shard.id}"))
            if failed is not None:
                given_up.append(failed)
        else:
            done += shard.trials
            pending.succeeded(shard)
    return done, given_up, tried


@pytest.mark.parametrize("bad", [[0], [31], [5, 6], [0, 9, 17, 30]])
def test_the_trials_that_fail_are_found_and_the_others_are_trained(bad):
    all_of_them = trials(32)
    fails = [all_of_them[index] for index in bad]
    done, given_up, tried = train(World().backlog(all_of_them), fails)
    assert sorted(trial.seed for failed in given_up for trial in failed.shard.trials) == bad
    assert sorted(trial.seed for trial in done) == [seed for seed in range(32) if seed not in bad]
    assert {failed.attempts for failed in given_up} == {6}  # 32, 16, 8, 4, 2, 1
    assert len(tried) <= 1 + 2 * 5 * len(bad)


def test_when_everything_fails_alike_it_is_not_all_taken_apart():
    groups = [trials(64, first=100 * number) for number in range(10)]
    done, given_up, tried = train(World().backlog(*groups), [trial for group in groups for trial in group])
    assert done == []
    assert sum(len(failed.shard.trials) for failed in given_up) == 640
    assert len(tried) < 64
    assert sum(len(failed.shard.trials) == 1 for failed in given_up) == MOST_ALIKE


def test_many_trials_that_fail_among_good_ones_cost_no_good_one(monkeypatch):
    members = trials(64 * 20)
    bad = members[5::30]  # two or three in each shard
    shards = [members[first : first + 64] for first in range(0, len(members), 64)]
    done, given_up, _ = train(World().backlog(*shards), bad)
    assert sorted(trial.seed for failed in given_up for trial in failed.shard.trials) == [trial.seed for trial in bad]
    assert len(done) == len(members) - len(bad)


def test_errors_of_another_type_are_still_taken_apart():
    pending = World().backlog(trials(64))
    train(pending, trials(64), "ValueError: bad")
    other = trials(2, first=500)
    pending._waiting.append(Shard(tuple(other)))
    _, given_up, _ = train(pending, other[:1], "KeyError: other")
    assert [failed.shard.trials for failed in given_up] == [(other[0],)]


def test_a_trial_that_is_known_to_have_raised_is_given_up_at_once_and_the_rest_goes_on():
    first, second, third = members = trials(3)
    pending = World().backlog(members)
    failed = pending.failed(Receipt(pending.next(), "here", error="ValueError", culprit=second), done={first.id})
    assert failed.shard.trials == (second,)
    assert pending.next().trials == (third,)
    assert not pending


def test_a_store_that_takes_nothing_is_no_reason_to_take_a_shard_apart():
    pending = World().backlog(trials(4))
    failed = pending.failed(Receipt(pending.next(), "here", error="OSError", store_is_unwritable=True))
    assert len(failed.shard.trials) == 4
    assert not pending


def test_what_is_in_the_store_by_now_is_not_trained_again():
    world = World()
    members = trials(4)
    pending = world.backlog(members)
    world.finished = {members[1].id, members[3].id}
    assert pending.next().trials == (members[0], members[2])
    assert pending.elsewhere == [members[1], members[3]]
    assert not pending


def test_what_another_launch_trains_is_left_to_it_and_taken_up_when_it_gives_up():
    world = World()
    members = trials(4)
    pending = world.backlog(members[:2], members[2:])
    world.claimed = {members[0].id, members[1].id, members[2].id}
    assert pending.next().trials == (members[3],)
    assert pending.next() is None
    assert (bool(pending), pending.deferred) == (True, 3)
    world.claimed = {members[0].id}
    world.finished = {members[1].id}
    assert pending.next().trials == (members[2],)
    assert (pending.elsewhere, pending.deferred) == ([members[1]], 1)
    world.claimed = set()
    assert pending.next().trials == (members[0],)
    assert not pending


def test_what_is_taken_up_is_packed_anew_into_shards_of_the_usual_size():
    world = World()
    short, long = trials(200), trials(70, steps=20)
    pending = world.backlog(short, long)
    world.claimed = {trial.id for trial in (*short, *long)}
    assert pending.next() is None
    world.claimed = set()
    found = []
    while pending:
        found.append(pending.next())
    assert {trial for shard in found for trial in shard.trials} == {*short, *long}
    assert max(len(shard.trials) for shard in found) <= 64
    assert all(len({trial.steps for trial in shard.trials}) == 1 for shard in found)
