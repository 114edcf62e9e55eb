import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.hypers import SACHypers
from agents.registry import Algorithm
from sweep.shards import DEFAULT_POPULATION, MIN_POPULATION, Group, Size, group_of, name_of, pack
from sweep.trials import Trial


def trials(count, steps=100_000, **hypers):
    return [Trial("SAC", "Pendulum-CA", SACHypers(**hypers), seed, steps, 1000, 0.99) for seed in range(count)]


@pytest.mark.parametrize(("count", "slots"), [(1, 2), (4, 2), (18, 2), (36, 2), (1500, 2), (1500, 64), (100, 7)])
def test_every_trial_is_in_exactly_one_shard_and_no_slot_stays_empty(count, slots):
    shards = pack(trials(count), slots)
    packed = [trial.id for shard in shards for trial in shard.trials]
    assert sorted(packed) == sorted(trial.id for trial in trials(count))
    assert len(shards) >= min(slots, count)
    assert max(len(shard.trials) for shard in shards) <= DEFAULT_POPULATION


numbers_of_trials = st.lists(st.integers(0, 60), min_size=4, max_size=4)
sizes = st.builds(Size, st.integers(1, 500), st.floats(0.001, 1e9))


@given(numbers_of_trials, st.integers(1, 300), st.dictionaries(st.integers(0, 3), sizes), st.integers(1, 10**7))
def test_trials_are_neither_lost_nor_doubled_whatever_sizes_are_given(counts, slots, given_sizes, steps):
    widths = [(8 * (i + 1),) for i in range(4)]
    groups = [trials(count, steps, hidden_layers=width) for count, width in zip(counts, widths, strict=True)]
    known = {Group("SAC", "Pendulum-CA", SACHypers(hidden_layers=widths[i]).shared()): size for i, size in given_sizes.items()}
    shards = pack([trial for group in groups for trial in group], slots, known)
    packed = [trial for shard in shards for trial in shard.trials]
    assert sorted(trial.id for trial in packed) == sorted(trial.id for group in groups for trial in group)
    assert all(shard.trials for shard in shards)
    for shard in shards:
        assert len(shard.trials) <= known.get(shard.group, Size()).population


def test_a_shard_takes_half_an_hour_at_most_whatever_the_length_of_a_trial():
    def largest(steps, size):
        members = trials(3600, steps)
        return max(len(shard.trials) for shard in pack(members, 2, {group_of(members[0]): size}))

    assert largest(100_000, Size(256, 4_000)) == 72  # 1,800 s × 4,000 agent-steps/s ÷ 100,000
    assert largest(100_000, Size(256, 10_000)) == 180
    assert 120 < largest(100_000, Size(128, 10_000)) <= 128
    assert largest(1_000_000, Size(256, 4_000)) == MIN_POPULATION
    assert largest(1_000, Size(256, 4_000)) > 200


@pytest.mark.parametrize(
    ("count", "slots", "expected"),
    [
        (36, 2, [18, 18]),
        (40, 2, [20, 20]),
        (70, 2, [18, 17, 18, 17]),
        (100, 2, [17, 17, 16] * 2),
        (8, 2, [4, 4]),
        (3, 8, [1] * 3),
    ],
)
def test_a_small_study_gives_every_slot_as_many_shards_and_no_small_ones_without_need(count, slots, expected):
    assert sorted(len(shard.trials) for shard in pack(trials(count), slots)) == sorted(expected)


def test_a_size_below_the_smallest_population_is_kept_for_it_is_what_fits_into_memory():
    members = trials(100)
    assert {len(shard.trials) for shard in pack(members, 2, {group_of(members[0]): Size(3)})} <= {2, 3}
    assert len(pack(members, 2, {group_of(members[0]): Size(1)})) == 100


def test_trials_that_cannot_share_a_tensor_program_are_kept_apart():
    mixed = trials(3) + trials(3, hidden_layers=(64, 64, 64)) + trials(3, steps=5)
    for shard in pack(mixed, 1):
        assert len({(trial.hypers.hidden_layers, trial.steps) for trial in shard.trials}) == 1
    together = trials(3) + trials(3, critic_step_size=0.5)
    assert len(pack(together, 1)) == 1


def test_the_longest_shards_come_first():
    shards = pack(trials(16, steps=10) + trials(16, steps=1000), 1)
    assert [shard.trials[0].steps for shard in shards] == [1000, 10]
    slow, fast = trials(16, hidden_layers=(64, 64, 64)), trials(16, steps=200_000)
    shards = pack(fast + slow, 1, {group_of(slow[0]): Size(64, 1_000), group_of(fast[0]): Size(64, 5_000)})
    assert [shard.group for shard in shards] == [group_of(slow[0]), group_of(fast[0])]


def test_a_shards_name_depends_on_its_trials_not_on_their_order():
    one, other = pack(trials(5), 1), pack(list(reversed(trials(5))), 1)
    assert one[0].id == other[0].id != pack(trials(6), 1)[0].id


def test_a_function_trains_one_trial_a_shard_and_is_one_group_whatever_its_hyperparameters(monkeypatch):
    function = Algorithm("mine:train", SACHypers, ("continuous",), "mine:train", one_trial=True)
    monkeypatch.setattr("sweep.shards.find_algorithm", lambda name: function)
    members = trials(3) + trials(3, batch_size=8)
    assert [len(shard.trials) for shard in pack(members, 1)] == [1] * 6
    assert len({group_of(trial) for trial in members}) == 1


def test_groups_of_one_agent_and_environment_are_told_apart_by_what_differs_and_nothing_else():
    narrow, wide = group_of(trials(1)[0]), group_of(trials(1, hidden_layers=(128, 128))[0])
    assert name_of(narrow, [narrow]) == "SAC on Pendulum-CA"
    assert name_of(narrow, [narrow, wide]) == "SAC on Pendulum-CA, hidden_layers [64, 64]"
    assert name_of(wide, [narrow, wide]) == "SAC on Pendulum-CA, hidden_layers [128, 128]"
