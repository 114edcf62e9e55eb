"""What verify finds: damage of bytes, and rows that break a law though their checksums are right."""

import hashlib
import json
import os
import random
import time
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_shards import tables, trial

from cluster.resuming import resumable
from sweep import checkpoints
from sweep.compaction import compact
from sweep.provenance import Provenance
from sweep.store import Store
from sweep.tables import members_table, shard_tables
from sweep.verification import verify


def rewrite(file, change):
    """Change the rows of a file, and make its manifest say that this was written."""
    table = pq.read_table(file, partitioning=None)
    changed = change(table)
    pq.write_table(changed, file)
    manifest = file.parent / "manifest.json"
    said = json.loads(manifest.read_text())
    content = file.read_bytes()
    said["files"][file.name] = {
        "bytes": len(content),
        "rows": changed.num_rows,
        "sha256": hashlib.sha256(content).hexdigest(),
    }
    if file.name == "trials.parquet" and "trial" in changed.column_names:
        said["trials"] = changed["trial"].to_pylist()
    known = json.dumps({key: said[key] for key in ("files", "replaces", "trials")}, sort_keys=True).encode()
    manifest.write_text(json.dumps(said | {"sha256": hashlib.sha256(known).hexdigest()}))


def with_value(column, row, value):
    """A change of one cell."""

    def change(table):
        values = table[column].to_pylist()
        values[row] = value
        return table.set_column(table.schema.get_field_index(column), column, pa.array(values, table.schema.field(column).type))

    return change


def without_row(row):
    return lambda table: table.filter(pc.not_equal(pa.array(range(table.num_rows)), row))


def swapped(first, second):
    def change(table):
        order = list(range(table.num_rows))
        order[first], order[second] = order[second], order[first]
        return table.take(order)

    return change


@pytest.fixture
def store(tmp_path):
    """Two shards; seeds 0, 1, 2 in shard a, episodes of 100 steps, with evaluation episodes."""
    store = Store.create(tmp_path)
    store.commit("a", tables([0, 1, 2], evaluated=True))
    store.commit("b", tables([3], evaluated=True))
    return store


def test_a_store_as_it_was_written_is_well(store, tmp_path):
    report = verify(store)
    assert (report.shards, report.trials, report.problems, report.unchecked, report.leftovers) == (2, 4, (), (), ())
    assert report.bytes == sum(file.stat().st_size for file in tmp_path.glob("shards/*/*"))


@pytest.mark.parametrize(
    ("file", "change", "what", "seeds"),
    [
        ("trials", with_value("trial", 0, "0" * 16), "has no episode of trials of the table trials", ["0" * 16]),
        ("trials", with_value("steps", 1, 999), "lengths do not sum to the trial's steps", [1]),
        ("trials", with_value("episodes", 1, 11), "episodes is not the number of episodes", [1]),
        ("trials", with_value("status", 2, "diverged"), "status and diverged_at do not go together", [2]),
        ("trials", with_value("status", 2, "failed"), "status and diverged_at do not go together", [2]),
        ("trials", with_value("episode_mean", 0, 0.5), "episode_mean does not follow from the episodes", [0]),
        ("trials", with_value("step_mean", 0, None), "step_mean does not follow from the episodes", [0]),
        ("trials", with_value("final_mean", 2, 0.25), "final_mean does not follow from the episodes", [2]),
        ("trials", with_value("best_episode", 2, 9.0), "best_episode does not follow from the episodes", [2]),
        ("trials", with_value("worst_episode", 2, -9e9), "worst_episode does not follow from the episodes", [2]),
        ("trials", with_value("worst_episode", 1, None), "worst_episode does not follow from the episodes", [1]),
        ("trials", without_row(1), "has episodes of trials that are not in the table trials", [1]),
        ("trials", lambda table: pa.concat_tables([table, table.slice(0, 1)]), "trials are there more than once", [0, 1, 2, 0]),
        ("trials", lambda table: table.drop_columns(["seed"]), "columns are not those of the schema: seed", [0, 1, 2]),
        ("episodes", with_value("episode", 12, 7), "episodes do not count from 0", [1]),
        ("episodes", with_value("first_step", 12, 7), "first_step is not where the episode before ended", [1]),
        ("episodes", with_value("length", 29, 99), "lengths do not sum to the trial's steps", [2]),
        ("episodes", with_value("ending", 0, "over"), "endings are not those of the schema", [0]),
        ("episodes", with_value("episodic_return", 0, 5.0), "episode_mean does not follow from the episodes", [0]),
        ("episodes", with_value("episodic_return", 0, None), "has NULLs", [0, 1, 2]),
        ("episodes", swapped(0, 10), "a trial's episodes do not lie side by side", [0, 1, 2]),
        ("episodes", lambda table: table.slice(10), "has no episode of trials of the table trials", [0]),
        ("steps", with_value("step", 1500, 7), "is not the episodes spelled out", [1]),
        ("steps", with_value("episodic_return", 2999, np.nan), "is not the episodes spelled out", [2]),
        ("steps", swapped(999, 1000), "is not the episodes spelled out", [0, 1]),
        ("steps", without_row(2999), "has 2,999 rows, the episodes 3,000 steps", [0, 1, 2]),
        (
            "evaluations",
            with_value("trial", 0, "0" * 16),
            "has evaluation episodes of trials that are not in the table trials",
            [0, 1, 2],
        ),
    ],
)
def test_rows_that_break_a_law_are_found_though_their_checksum_is_right(store, tmp_path, file, change, what, seeds):
    rewrite(tmp_path / "shards" / "a" / f"{file}.parquet", change)
    problems = [problem for problem in verify(store).problems if problem.what.startswith(what)]
    evaluated = [trial(seed, evaluation=(500, 2)).id if isinstance(seed, int) else seed for seed in seeds]
    assert [(one.shard, sorted(one.trials)) for one in problems] == [("a", sorted(evaluated))]
    assert verify(store).trials >= 3  # the other shard is checked all the same


def test_a_shard_from_before_there_was_a_worst_episode_is_well(store, tmp_path):
    rewrite(tmp_path / "shards" / "a" / "trials.parquet", lambda table: table.drop_columns(["worst_episode"]))
    assert verify(store).problems == ()
    rewrite(tmp_path / "shards" / "a" / "trials.parquet", with_value("best_episode", 0, 7e9))
    assert [problem.what for problem in verify(store).problems] == ["best_episode does not follow from the episodes"]


def test_quick_leaves_out_the_comparison_of_steps_and_nothing_else(store, tmp_path):
    rewrite(tmp_path / "shards" / "a" / "steps.parquet", with_value("step", 1500, 7))
    assert verify(store, quick=True).problems == ()
    assert len(verify(store).problems) == 1
    rewrite(tmp_path / "shards" / "b" / "trials.parquet", with_value("episode_mean", 0, 7.0))
    assert len(verify(store, quick=True).problems) == 1


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_scores_that_training_writes_are_those_that_verify_computes(data, tmp_path_factory):
    """Two computations that share no code, on runs with cut, diverged and no completed episodes."""
    number = st.floats(-1e4, 1e4, width=32)
    episode = st.tuples(st.integers(1, 60), number, st.sampled_from([0, 1]))
    runs = []
    for _ in range(data.draw(st.integers(1, 4))):
        episodes = data.draw(st.lists(episode, max_size=6))
        used = sum(length for length, _, _ in episodes)
        runs.append([*episodes, (400 - used, data.draw(number), data.draw(st.sampled_from([0, 1, 2])))])
    diverged = data.draw(st.lists(st.booleans(), min_size=len(runs), max_size=len(runs)))
    flat = [(run, number, *one) for run, episodes in enumerate(runs) for number, one in enumerate(episodes)]
    columns = [np.array(column) for column in zip(*flat, strict=True)]
    length = columns[2].astype(np.int32)
    first = np.concatenate([np.cumsum([0, *(one[0] for one in episodes[:-1])]) + 1 for episodes in runs])
    returns = np.where(np.array(diverged)[columns[0]] & (columns[1] > 1), np.nan, columns[3])
    records = SimpleNamespace(
        steps=400,
        agent=columns[0].astype(np.int32),
        episode=columns[1].astype(np.int32),
        first_step=first.astype(np.int32),
        length=length,
        episodic_return=returns.astype(np.float32),
        ending=columns[4].astype(np.uint8),
        diverged_at=np.where(diverged, 7, 0),
    )
    trials = [trial(seed, 400) for seed in range(len(runs))]
    store = Store.create(tmp_path_factory.mktemp("scores"))
    store.commit("shard", shard_tables(trials, records, 1.0, Provenance("cpu", "torch", "host", None, "{}")))
    assert verify(store).problems == ()


@pytest.mark.parametrize("compacted", [False, True])
def test_a_flipped_byte_is_found_wherever_it_is(store, tmp_path, compacted):
    if compacted:
        compact(store)
    generator = random.Random(0)
    files = sorted(tmp_path.glob("shards/*/*"))
    for _ in range(200):
        file = generator.choice(files)
        whole = file.read_bytes()
        place, bits = generator.randrange(len(whole)), generator.randrange(1, 256)
        file.write_bytes(whole[:place] + bytes([whole[place] ^ bits]) + whole[place + 1 :])
        problems = verify(store, quick=True).problems
        assert [(problem.shard, problem.file) for problem in problems] == [(file.parent.name, file)], (file, place, bits)
        seeds = (0, 1, 2) if file.parent.name == "a" else (3,) if file.parent.name == "b" else (0, 1, 2, 3)
        assert sorted(problems[0].trials) == sorted(trial(seed, evaluation=(500, 2)).id for seed in seeds)
        file.write_bytes(whole)
    assert verify(store).problems == ()


@pytest.mark.parametrize("name", ["trials.parquet", "episodes.parquet", "steps.parquet", "evaluations.parquet"])
def test_a_file_that_is_truncated_or_missing_is_named_and_the_rest_is_checked(store, tmp_path, name):
    file = tmp_path / "shards" / "a" / name
    whole = file.read_bytes()
    for size in (len(whole) - 1, len(whole) // 2, 0):
        file.write_bytes(whole[:size])
        (problem,) = verify(store).problems
        assert (problem.file, problem.what) == (file, f"{size:,} bytes, {len(whole):,} were written")
        assert len(problem.trials) == 3
    file.unlink()
    (problem,) = verify(store).problems
    assert (problem.file, problem.what) == (file, "it is missing")


def test_files_that_the_manifest_does_not_name_are_a_problem(store, tmp_path):
    store.commit("c", tables([4]))
    (tmp_path / "shards" / "c" / "evaluations.parquet").write_bytes(
        (tmp_path / "shards" / "b" / "evaluations.parquet").read_bytes()
    )
    (problem,) = verify(store).problems
    assert (problem.shard, problem.file.name, problem.what) == ("c", "evaluations.parquet", "the manifest does not name it")


def test_shards_without_checksums_are_held_to_the_laws_alone(store, tmp_path):
    (tmp_path / "shards" / "a" / "manifest.json").unlink()
    report = verify(store)
    assert (report.problems, report.unchecked) == ((), ("a",))
    (tmp_path / "shards" / "a" / "steps.parquet").write_bytes(b"PAR1")
    (problem,) = verify(store).problems
    assert problem.file.name == "steps.parquet" and problem.what.startswith("cannot be read")


def test_a_trial_in_two_shards_is_found(store, tmp_path):
    other = Store.create(tmp_path / "other")
    other.commit("c", tables([1, 4], evaluated=True))
    (tmp_path / "other" / "shards" / "c").rename(tmp_path / "shards" / "c")
    (problem,) = verify(store).problems
    assert (problem.shard, problem.what) == ("c", "trials are in a, too")
    assert problem.trials == (trial(1, evaluation=(500, 2)).id,)


def test_files_of_studies_are_read(store, tmp_path):
    store.write_study("study", "", members_table("study", {"tune": [trial(0)]}))
    assert verify(store).problems == ()
    for name in ("members.parquet", "selections.parquet"):
        file = tmp_path / "studies" / "study" / name
        whole = file.read_bytes() if file.exists() else None
        file.write_bytes(b"no Parquet")
        (problem,) = verify(store).problems
        assert (problem.shard, problem.file, problem.trials) == ("", file, ())
        pq.write_table(pa.table({"study": ["study"]}), file)
        (problem,) = verify(store).problems
        assert problem.what.startswith("has no column ")
        file.unlink() if whole is None else file.write_bytes(whole)


def test_what_killed_processes_left_behind_is_mentioned_once_it_is_a_day_old(store, tmp_path):
    store.write_study("study", "", members_table("study", {}))
    store.record_failure("shard", [trial(9)], "lost", "host", "gone")
    left = [
        tmp_path / ".staging" / "shard-host-1-abc",
        tmp_path / ".launches" / "host-1-abc.json",
        tmp_path / ".checkpoints" / ".shard.checkpoint-1-abc",
        tmp_path / "studies" / "study" / ".members.parquet-1-abc",
        tmp_path / "failures" / ".shard.json-1-abc",
    ]
    for file in left:
        file.parent.mkdir(exist_ok=True)
        file.write_text("half writt")
    assert verify(store).leftovers == ()
    old = time.time() - 25 * 3600
    for file in left:
        os.utime(file, (old, old))
    report = verify(store)
    assert (report.problems, sorted(report.leftovers)) == ((), sorted(left))
    assert len(store.finished_trials()) == 4
    target = store.quarantine("b")
    assert verify(store).quarantined == (target,)


@pytest.mark.parametrize("days", [2, 29.9, 30.1])
def test_a_checkpoint_is_left_over_when_no_launch_would_go_on_with_it(store, tmp_path, days):
    file = checkpoints.file_of(tmp_path, "shard")
    checkpoints.save(file, {"trials": [trial(9).id], "step": 1}, {})
    old = time.time() - days * 86400
    os.utime(file, (old, old))
    found = verify(store).leftovers
    resumable(tmp_path, [])  # no trial is asked for: what is still of use stays
    assert found == (() if file.exists() else (file,))
    assert file.exists() == (days < 30)


def test_trials_of_a_shard_of_which_no_file_can_be_read_are_named_by_its_manifest(store, tmp_path):
    for file in tmp_path.glob("shards/a/*.parquet"):
        file.write_bytes(b"")
    report = verify(store)
    assert report.trials == 4
    assert report.damaged_trials == {trial(seed, evaluation=(500, 2)).id for seed in (0, 1, 2)}


def test_a_manifest_that_names_other_trials_than_the_tables_is_found(store, tmp_path):
    file = tmp_path / "shards" / "a" / "manifest.json"
    said = json.loads(file.read_text())
    lost = said["trials"].pop()
    known = json.dumps({key: said[key] for key in ("files", "replaces", "trials")}, sort_keys=True).encode()
    file.write_text(json.dumps(said | {"sha256": hashlib.sha256(known).hexdigest()}))
    (problem,) = verify(store).problems
    assert (problem.shard, problem.file, problem.trials) == ("a", file, (lost,))
    assert problem.what == "names other trials than the tables"
