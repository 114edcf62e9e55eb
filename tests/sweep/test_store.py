import multiprocessing
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest

from agents.hypers import SACHypers
from sweep.messages import UserError
from sweep.provenance import Provenance
from sweep.store import Store
from sweep.tables import shard_tables
from sweep.trials import Trial

ROOT = Path(__file__).parent.parent.parent


def tables(seeds, steps=1000, length=100):
    """A shard of one trial a seed, with episodes of one length and returns that do not repeat."""
    trials = [Trial("SAC", "Pendulum-CA", SACHypers(), seed, steps, 1000, 0.99) for seed in seeds]
    episodes = steps // length
    rows = len(seeds) * episodes
    generator = np.random.default_rng(0)
    records = SimpleNamespace(
        steps=steps,
        agent=np.repeat(np.arange(len(seeds), dtype=np.int32), episodes),
        episode=np.tile(np.arange(episodes, dtype=np.int32), len(seeds)),
        first_step=np.tile(np.arange(episodes, dtype=np.int32) * length + 1, len(seeds)),
        length=np.full(rows, length, np.int32),
        episodic_return=generator.normal(size=rows).astype(np.float32),
        ending=np.zeros(rows, np.uint8),
        diverged_at=np.zeros(len(seeds), np.int64),
    )
    return shard_tables(trials, records, 1.0, Provenance("cpu", "torch", "host", None, "{}"))


def rows(store, table):
    return [
        row
        for file in sorted(store.path.glob(f"shards/*/{table}.parquet"))
        for row in pq.read_table(file, partitioning=None).to_pylist()
    ]


def test_what_is_committed_can_be_read_back_and_is_finished(tmp_path):
    store = Store.create(tmp_path / "store")
    committed = tables([0, 1])
    assert store.commit("shard-1", committed) == 2
    assert store.finished_trials() == set(committed.trials["trial"].to_pylist())
    assert rows(store, "episodes") == committed.episodes.to_pylist()
    assert rows(store, "steps") == [row for block in committed.steps_in_blocks(100) for row in block.to_pylist()]
    assert [row["trial"] for row in rows(store, "trials")] == committed.trials["trial"].to_pylist()
    assert not list((tmp_path / "store" / ".staging").iterdir())


def test_a_trial_is_never_there_twice_whichever_shard_it_comes_with(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard-1", tables([0, 1]))
    assert store.commit("shard-1", tables([0, 1])) == 0
    assert store.commit("shard-2", tables([1, 2])) == 1
    assert sorted(row["seed"] for row in rows(store, "trials")) == [0, 1, 2]
    assert len(rows(store, "steps")) == 3000


def _commit(arguments):
    path, shard, seeds = arguments
    return Store(path).commit(shard, tables(seeds))


def test_processes_that_commit_the_same_trials_at_once_leave_each_exactly_once(tmp_path):
    Store.create(tmp_path)
    work = [(tmp_path, f"shard-{i % 5}-{i // 5}", [i % 5, (i + 1) % 5]) for i in range(40)]
    with multiprocessing.get_context("spawn").Pool(4) as pool:
        new = pool.map(_commit, work, chunksize=1)
    assert sum(new) == 5
    assert sorted(row["seed"] for row in rows(Store(tmp_path), "trials")) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("fault", ["write", "write of steps", "fsync", "rename"])
def test_a_commit_that_fails_leaves_nothing_visible_and_can_be_repeated(tmp_path, monkeypatch, fault):
    store = Store.create(tmp_path)
    with monkeypatch.context() as patch:

        def fail(*_arguments, **_options):
            raise OSError(28, "No space left on device")

        match fault:
            case "write":
                patch.setattr("sweep.store.pq.write_table", fail)
            case "write of steps":
                patch.setattr("sweep.store.pq.ParquetWriter.write_batch", fail)
            case "fsync":
                patch.setattr(os, "fsync", fail)
            case "rename":
                patch.setattr("pathlib.Path.rename", fail)
        with pytest.raises(OSError, match="No space"):
            store.commit("shard-1", tables([0]))
    assert store.finished_trials() == set()
    assert not list((tmp_path / ".staging").iterdir())
    assert store.commit("shard-1", tables([0])) == 1


def test_everything_is_flushed_to_disk_before_it_becomes_visible(tmp_path, monkeypatch):
    store = Store.create(tmp_path)
    calls = []
    flush, rename = os.fsync, type(tmp_path).rename

    def spy_fsync(descriptor):
        calls.append(("fsync", os.path.basename(os.readlink(f"/proc/self/fd/{descriptor}"))))
        flush(descriptor)

    def spy_rename(self, target):
        calls.append(("rename", target.name))
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", spy_fsync)
    monkeypatch.setattr("pathlib.Path.rename", spy_rename)
    store.commit("shard-1", tables([0]))
    *before, (name, target), after = calls
    assert (name, target) == ("rename", "shard-1")
    assert [call[1] for call in before[:3]] == ["trials.parquet", "episodes.parquet", "steps.parquet"]
    assert before[3][0] == "fsync" and before[3][1].startswith("shard-1-")
    assert after == ("fsync", "shards")


def test_steps_cost_about_as_much_as_the_episodes(tmp_path):
    """100,000 rows a trial: 1.2 MB in memory, and two kilobytes on disk."""
    store = Store.create(tmp_path)
    store.commit("shard", tables(range(16), steps=100_000, length=200))
    file = tmp_path / "shards" / "shard" / "steps.parquet"
    assert file.stat().st_size / 16 < 16 * 500 + 1000
    metadata = pq.ParquetFile(file).metadata
    assert metadata.num_rows == 1_600_000
    columns = {metadata.row_group(0).column(i).path_in_schema: metadata.row_group(0).column(i).encodings for i in range(3)}
    assert "DELTA_BINARY_PACKED" in columns["step"]
    assert "RLE_DICTIONARY" in columns["episodic_return"]
    episodes = file.parent / "episodes.parquet"
    print(f"steps {file.stat().st_size / 16:.0f} bytes a trial, episodes {episodes.stat().st_size / 16:.0f}")


def test_row_groups_of_steps_hold_100_000_rows_whether_trials_are_long_or_short(tmp_path):
    store = Store.create(tmp_path)
    store.commit("long", tables([0], steps=250_000, length=1000))
    store.commit("short", tables(range(1, 251), steps=1000))
    for shard in ("long", "short"):
        metadata = pq.ParquetFile(tmp_path / "shards" / shard / "steps.parquet").metadata
        assert [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)] == [100_000, 100_000, 50_000]


MEMORY = """
import resource, sys
from sweep.store import Store
from test_store import tables

store = Store.create(sys.argv[1])
store.commit("small", tables([0], steps=100_000, length=1000))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
large = tables(range(256), steps=100_000, length=1000)
assert store.commit("large", large) == 255
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def test_memory_does_not_grow_with_the_steps_that_are_committed(tmp_path):
    """25.6 million rows, 300 MB, written twice because one of the trials is there already."""
    path = os.pathsep.join([str(ROOT), str(Path(__file__).parent)])
    command = [sys.executable, "-c", MEMORY, str(tmp_path / "store")]
    ran = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    assert int(ran.stdout) < 100
    assert pq.ParquetFile(tmp_path / "store" / "shards" / "large" / "steps.parquet").metadata.num_rows == 25_500_000


def test_writing_the_same_study_again_touches_no_file(tmp_path):
    from sweep.tables import members_table

    store = Store.create(tmp_path)
    members = members_table("study", "tune", [Trial("SAC", "Pendulum-CA", SACHypers(), 0, 5, 1000, 0.99)])
    store.write_study("study", "text", members)
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "studies" / "study").iterdir()}
    store.write_study("study", "text", members)
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "studies" / "study").iterdir()} == before


def test_a_folder_that_is_not_a_store_is_refused_and_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for refuse in (Store.open, Store.create):
        with pytest.raises(UserError, match=r"is not a store: it has no readable sweep-store.json"):
            refuse(tmp_path)
    with pytest.raises(UserError, match="is not a store"):
        Store.create(tmp_path / "notes.txt")
    with pytest.raises(UserError, match="there is no store here"):
        Store.open(tmp_path / "missing")
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]


def test_a_store_of_another_format_is_refused(tmp_path):
    (tmp_path / "sweep-store.json").write_text('{"format": 99}')
    with pytest.raises(UserError, match="another format"):
        Store.open(tmp_path)
