"""The arithmetic of plans, against numbers worked out by hand."""

import io
import itertools

import numpy as np
import pytest
from rich.console import Console

from agents.hypers import SACHypers
from agents.records import Records
from sweep.calibration import Calibration
from sweep.disk import episode_lengths, predicted_bytes
from sweep.plan import Basis, Slots, makespan, plan
from sweep.plan_report import show
from sweep.provenance import Provenance
from sweep.shards import Group, Shard, group_of, pack
from sweep.store import Store
from sweep.tables import shard_tables
from sweep.trials import Trial

MB = 2**20
RATE = 4_000.0
SIMPLE = Calibration({16: RATE, 64: RATE}, base_bytes=300 * MB, agent_bytes=MB, row_bytes=48, commit_bytes=60 * MB)


def trials(count, steps=100_000, environment="Pendulum-CA", evaluation=None, **hypers):
    return [Trial("SAC", environment, SACHypers(**hypers), seed, steps, 1_000, 0.99, evaluation) for seed in range(count)]


def planned(shards, slots=Slots(2, 2, 2), calibration=SIMPLE, num_trials=None, threads=1):  # noqa: B008
    groups = {shard.group: Basis(calibration, "measured in 3 s") for shard in shards}
    count = sum(len(shard.trials) for shard in shards) if num_trials is None else num_trials
    return plan("mine", count, shards, groups, slots, "native-avx2", {}, threads)


@pytest.mark.parametrize(("seconds", "slots", "hours"), [([3, 2, 2], 1, 7), ([3, 2, 2], 2, 4), ([3, 2, 2], 3, 3), ([], 2, 0)])
def test_jobs_start_in_their_order_when_a_slot_is_free(seconds, slots, hours):
    assert makespan(seconds, slots) == hours


def test_counts_and_hours_are_those_of_what_is_missing():
    shards = [Shard(tuple(trials(64))), Shard(tuple(trials(64, environment="Acrobot-CA"))), Shard(tuple(trials(32)))]
    found = planned(shards, num_trials=1_000)
    assert (found.trials, found.finished, found.missing, found.shards) == (1_000, 840, 160, 3)
    assert found.agent_steps == 16_000_000
    assert found.core_hours == pytest.approx(16_000_000 / RATE / 3600)
    assert found.hours == pytest.approx((64 + 32) * 100_000 / RATE / 3600)  # the third shard starts when the first two end
    assert [(group.trials, group.shards, group.population) for group in found.groups] == [(96, 2, 64), (64, 1, 64)]
    assert sum(group.core_hours for group in found.groups) == pytest.approx(found.core_hours)


def test_workers_in_excess_of_the_cores_make_nothing_faster():
    shards = [Shard((trial,)) for trial in trials(8)]
    two, eight = planned(shards, Slots(2, 2, 2)), planned(shards, Slots(8, 8, 2))
    assert eight.hours == pytest.approx(two.hours)
    assert planned(shards, Slots(2, 2, 2), threads=2).core_hours == pytest.approx(2 * two.core_hours)


def test_evaluation_episodes_take_time_too():
    plain, evaluated = (planned([Shard(tuple(trials(16, evaluation=e)))]).hours for e in (None, (10_000, 10)))
    assert evaluated / plain == pytest.approx(1 + 0.15 * 10 * 10 * 1_000 / 100_000)


def test_memory_is_the_largest_shards_and_a_machines_is_that_of_its_largest_shards_at_once():
    large, small = Shard(tuple(trials(64))), Shard(tuple(trials(16, environment="Acrobot-CA")))
    first = SIMPLE.peak_bytes(large.trials[0], 64, again=False)
    alone = planned([large], Slots(2, 2, 2))
    assert (alone.memory_bytes, alone.machine_memory_bytes) == (first, first)
    several = planned([large, small, small], Slots(2, 2, 2))
    assert several.memory_bytes == first + 60 * MB  # a worker that takes a second shard has committed one before
    assert several.machine_memory_bytes == several.memory_bytes + SIMPLE.peak_bytes(small.trials[0], 16)
    assert [group.memory_bytes for group in several.groups] == [
        several.memory_bytes,
        SIMPLE.peak_bytes(small.trials[0], 16),
    ]


def test_nothing_missing_is_a_plan_of_zeros():
    found = planned([], num_trials=7)
    assert (found.missing, found.finished, found.hours, found.core_hours, found.bytes, found.memory_bytes) == (0, 7, 0, 0, 0, 0)


def test_a_plan_as_json_has_the_names_that_scripts_rely_on():
    found = planned([Shard(tuple(trials(64)))]).to_json()
    assert {"trials", "finished", "missing", "steps", "core_hours", "bytes"} <= set(found)
    assert {"memory_bytes", "machine_memory_bytes", "groups", "hours", "engine"} <= set(found)
    assert (found["steps"], found["missing"]) == (6_400_000, 64)
    assert found["groups"][0]["shared"]["hidden_layers"] == (64, 64)


def shown(found):
    output = io.StringIO()
    show(found, Console(file=output, width=40))
    return output.getvalue()


def test_without_a_terminal_a_plan_is_lines_that_are_not_wrapped():
    text = shown(planned(pack(trials(640) + trials(640, hidden_layers=(8,)), 2), Slots(2, 2, 2, 16 * 2**30)))
    first, *rest = text.splitlines()
    assert first.startswith("mine: 1,280 trials, 0 finished, 1,280 missing: 128,000,000 agent-steps in 20 shards on 2 workers")
    (row,) = [line for line in rest if "hidden_layers [8]" in line]
    assert row.split()[5:10] == ["640", "10", "64", "4,000", "4.4"]
    assert row.rstrip().endswith("MB   measured in 3 s")
    assert "time    8.9 core-hours: about 4.4 hours on 2 workers" in text
    assert "(16.0 GB are available)" in text
    assert "\x1b" not in text


def test_a_plan_says_when_its_rates_are_guesses_and_when_memory_does_not_suffice():
    shards = [Shard(tuple(trials(64)))]
    text = shown(plan("mine", 64, shards, {shards[0].group: Basis(SIMPLE, "nominal")}, Slots(2, 2, 2, 300 * MB), "torch", {}))
    assert "Nominal rates are guesses" in text
    assert "more memory than is available" in text
    assert "Nominal" not in shown(planned(shards))


def test_a_finished_study_is_one_line():
    assert shown(planned([], num_trials=7)) == "mine: all 7 trials are finished; nothing to do.\n"


def episodes(count, steps, length, generator):
    """Records of `count` agents, with returns that differ: episodes as long as the cutoff, or of lengths around a shorter one."""
    each = steps // length
    ends = np.tile(np.arange(1, each + 1) * length, (count, 1))
    if length < 1_000:
        ends[:, :-1] += generator.integers(-length // 2, length // 2, (count, each - 1))
    starts = np.hstack([np.zeros((count, 1), np.int64), ends[:, :-1]])
    return Records(
        steps=steps,
        agent=np.repeat(np.arange(count), each).astype(np.int32),
        episode=np.tile(np.arange(each), count).astype(np.int32),
        first_step=(starts + 1).ravel().astype(np.int32),
        length=(ends - starts).ravel().astype(np.int32),
        episodic_return=generator.normal(0, 100, count * each).astype(np.float32),
        ending=np.ones(count * each, np.uint8),
        diverged_at=np.zeros(count, np.int64),
    )


@pytest.mark.parametrize(
    ("count", "steps", "length"), [(1, 100_000, 1_000), (16, 20_000, 1_000), (64, 100_000, 1_000), (32, 50_000, 100)]
)
def test_the_bytes_on_disk_are_as_predicted(tmp_path, count, steps, length):
    members = trials(count, steps)
    provenance = Provenance("cpu", "native-avx2", "host", "a" * 40, "{}")
    store = Store.create(tmp_path)
    store.commit("shard", shard_tables(members, episodes(count, steps, length, np.random.default_rng(0)), 60.0, provenance))
    there = sum(file.stat().st_size for file in (tmp_path / "shards").rglob("*.parquet"))
    lengths = episode_lengths(tmp_path)
    assert lengths == {"Pendulum-CA": length}
    assert predicted_bytes([Shard(tuple(members))], lengths) == pytest.approx(there, rel=0.15)


def test_without_experience_episodes_are_as_long_as_the_cutoff_and_damaged_files_teach_nothing(tmp_path):
    shard = Shard(tuple(trials(2)))
    assert (
        predicted_bytes([shard], {})
        == predicted_bytes([shard], {"Pendulum-CA": 1_000})
        < predicted_bytes([shard], {"Pendulum-CA": 100})
    )
    (tmp_path / "shards" / "one").mkdir(parents=True)
    (tmp_path / "shards" / "one" / "trials.parquet").write_text("damaged")
    assert episode_lengths(tmp_path) == {}


def test_groups_come_in_the_order_of_the_study():
    shards = pack(list(itertools.chain(trials(8), trials(64, environment="Acrobot-CA"))), 1)
    groups = {group_of(trial): Basis(SIMPLE, "nominal") for trial in (*trials(1), *trials(1, environment="Acrobot-CA"))}
    found = plan("mine", 72, shards, groups, Slots(1, 1, 1), "torch", {})
    assert [group.group.environment for group in found.groups] == ["Pendulum-CA", "Acrobot-CA"]
    assert isinstance(found.groups[0].group, Group)
