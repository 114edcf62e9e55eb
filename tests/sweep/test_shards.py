import pytest

from agents.hypers import SACHypers
from sweep.shards import MAX_POPULATION, MIN_POPULATION, pack
from sweep.trials import Trial


def trials(count, steps=100_000, **hypers):
    return [Trial("SAC", "Pendulum-CA", SACHypers(**hypers), seed, steps, 1000, 0.99) for seed in range(count)]


@pytest.mark.parametrize(("count", "slots"), [(1, 2), (4, 2), (18, 2), (36, 2), (1500, 2), (1500, 64), (100, 7)])
def test_every_trial_is_in_exactly_one_shard_and_no_slot_stays_empty(count, slots):
    shards = pack(trials(count), slots)
    packed = [trial.id for shard in shards for trial in shard.trials]
    assert sorted(packed) == sorted(trial.id for trial in trials(count))
    assert len(shards) >= min(slots, count)
    assert max(len(shard.trials) for shard in shards) <= MAX_POPULATION


def test_a_shard_takes_minutes_whatever_the_length_of_a_trial():
    assert max(len(shard.trials) for shard in pack(trials(1000, steps=1_000_000), 2)) == MIN_POPULATION
    assert max(len(shard.trials) for shard in pack(trials(1000, steps=1_000), 2)) > 60


def test_trials_that_cannot_share_a_tensor_program_are_kept_apart():
    mixed = trials(3) + trials(3, hidden_layers=(64, 64, 64)) + trials(3, steps=5)
    for shard in pack(mixed, 1):
        assert len({(trial.hypers.hidden_layers, trial.steps) for trial in shard.trials}) == 1
    together = trials(3) + trials(3, critic_step_size=0.5)
    assert len(pack(together, 1)) == 1


def test_the_longest_shards_come_first():
    shards = pack(trials(16, steps=10) + trials(16, steps=1000), 1)
    assert [shard.trials[0].steps for shard in shards] == [1000, 10]


def test_a_shards_name_depends_on_its_trials_not_on_their_order():
    one, other = pack(trials(5), 1), pack(list(reversed(trials(5))), 1)
    assert one[0].id == other[0].id != pack(trials(6), 1)[0].id
