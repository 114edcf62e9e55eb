"""Compaction: the same rows in fewer files, whoever looks on and whatever fails."""

import contextlib
import dataclasses
import errno
import fcntl
import multiprocessing
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from faults import Faults, Killed
from small_shards import rows, tables, trial

from sweep import manifest
from sweep.compaction import compact
from sweep.files import UnwritableError
from sweep.manifest import DamagedError
from sweep.store import Store
from sweep.verification import verify

ROOT = Path(__file__).parent.parent.parent


def in_order(store, table):
    key = {"trials": ("trial",), "episodes": ("trial", "episode"), "evaluations": ("trial", "step", "episode")}
    return sorted(
        rows(store.path, table, store.shards()), key=lambda row: [row[name] for name in key.get(table, ("trial", "step"))]
    )


def small(path, shards=5, **options):
    """A store of shards with two trials each."""
    store = Store.create(path)
    for number in range(shards):
        store.commit(f"shard-{number}", tables([2 * number, 2 * number + 1], **options))
    return store


def test_many_small_shards_become_one_with_the_same_rows_by_setting_and_seed(tmp_path):
    store = small(tmp_path, evaluated=True)
    names = ("trials", "episodes", "evaluations", "steps")
    before = {table: in_order(store, table) for table in names}
    counts = compact(store)
    assert (counts.shards_before, counts.shards_after, counts.trials, counts.damaged) == (5, 1, 10, ())
    assert {table: in_order(store, table) for table in names} == before
    (folder,) = tmp_path.glob("shards/*")
    assert folder.name.startswith("c-") and folder == store.shards()[0]
    for table in names:
        file = pq.read_table(folder / f"{table}.parquet", partitioning=None)
        seeds = [row["seed"] for row in before["trials"] for _ in [0]]
        seed_of = {row["trial"]: row["seed"] for row in before["trials"]}
        found = [seed_of[name] for name in file["trial"].to_pylist()]
        assert found == sorted(found) and len(set(found)) == len(seeds)
    assert counts.bytes_after < counts.bytes_before / 3
    assert verify(store).problems == ()
    assert not list(tmp_path.glob(".staging/*"))


def test_agents_environments_and_evaluated_trials_are_not_mixed(tmp_path):
    store = Store.create(tmp_path)
    for number in range(3):
        store.commit(f"a{number}", tables([number]))
        store.commit(f"b{number}", tables([number], environment="Acrobot-CA"))
        store.commit(f"c{number}", tables([number], evaluated=True))
    store.commit("d", tables([0], environment="MountainCar-CA"))
    assert compact(store).shards_after == 4
    assert len(store.finished_trials()) == 10
    assert verify(store).problems == ()
    assert (tmp_path / "shards" / "d").exists()


def test_shards_grow_to_the_target_and_are_then_left_alone(tmp_path):
    store = small(tmp_path, shards=7)
    counts = compact(store, target_trials=6)
    assert sorted(pq.read_metadata(folder / "trials.parquet").num_rows for folder in store.shards()) == [2, 6, 6]
    assert counts.trials == 12
    left = store.shards()
    assert compact(store, target_trials=6).trials == 0
    assert store.shards() == left
    store.commit("late", tables([100]))
    assert compact(store, target_trials=6).trials == 3
    assert compact(store, target_trials=12).trials == 0  # half of the target is enough
    store.commit("later", tables([101]))
    assert compact(store).shards_after == 1  # compacted shards are compacted again
    assert len(store.finished_trials()) == 16
    assert verify(store).problems == ()


@pytest.mark.parametrize("name", ["trials.parquet", "steps.parquet", "manifest.json"])
def test_damaged_shards_are_left_alone_and_named(tmp_path, name):
    store = small(tmp_path)
    file = tmp_path / "shards" / "shard-2" / name
    whole = file.read_bytes()
    file.write_bytes(whole[:300] + bytes([whole[300] ^ 1]) + whole[301:])
    counts = compact(store)
    assert {problem.shard for problem in counts.damaged} == {"shard-2"}
    assert (counts.trials, counts.shards_after) == (8, 2)
    file.write_bytes(whole)
    assert len(store.finished_trials()) == 10
    assert verify(store).problems == ()


def test_shards_of_old_without_checksums_are_compacted_and_have_them_then(tmp_path):
    store = small(tmp_path)
    for file in tmp_path.glob("shards/*/manifest.json"):
        file.unlink()
    assert len(verify(store).unchecked) == 5
    assert compact(store).trials == 10
    assert verify(store).unchecked == ()


@pytest.mark.parametrize(
    ("error", "stride"),
    [
        pytest.param(errno.ENOSPC, 41, id="some calls, full"),
        pytest.param(None, 29, id="some calls, killed"),
        pytest.param(errno.ENOSPC, 1, id="full", marks=pytest.mark.slow),
        pytest.param(errno.EIO, 1, id="input-output error", marks=pytest.mark.slow),
        pytest.param(None, 1, id="killed", marks=pytest.mark.slow),
    ],
)
def test_whichever_call_fails_every_trial_is_seen_exactly_once_and_the_next_compaction_cleans_up(tmp_path, error, stride):
    at, faults, kinds = 1, None, set()
    small(tmp_path / "made", shards=3)
    while faults is None or faults.happened:
        store = Store.open(shutil.copytree(tmp_path / "made", tmp_path / str(at)))
        faults = Faults(store.path, at, error)
        with faults.installed(), contextlib.suppress(UnwritableError, Killed):
            compact(store)
        looking = Store.open(store.path)
        seeds = sorted(row["seed"] for row in rows(store.path, "trials", looking.shards()))
        assert seeds == [0, 1, 2, 3, 4, 5], (at, faults.calls[-1])
        assert len(looking.finished_trials()) == 6
        assert looking.commit("again", tables([0, 5])) == 0
        assert verify(looking).problems == ()
        compact(looking)
        assert len(list(store.path.glob("shards/*"))) == 1
        assert (verify(looking).problems, verify(looking).trials, looking.superseded()) == ((), 6, [])
        kinds |= set(faults.calls)
        at += stride
    assert kinds >= {"open", "mkdir", "write", "flush", "fsync", "rename", "unlink", "rmdir"}


def test_what_was_replaced_stays_invisible_when_the_compacted_shard_is_compacted_again(tmp_path, monkeypatch):
    """The first compaction was killed before it removed anything; a second one began before that."""
    store = small(tmp_path, shards=3)
    with monkeypatch.context() as patch:
        patch.setattr(Store, "discard", lambda *_: None)
        compact(store)
        store.commit("late", tables([100]))
        compact(store)
    assert len(list(tmp_path.glob("shards/*"))) == 6
    assert [folder.name[:2] for folder in store.shards()] == ["c-"]
    assert len(store.superseded()) == 5
    assert verify(store).trials == 7 and verify(store).problems == ()
    assert len(verify(store).leftovers) == 5
    store.discard([folder for folder in store.superseded() if folder.name.startswith("c-")])
    assert [folder.name[:2] for folder in store.shards()] == ["c-"]
    compact(store)
    assert len(list(tmp_path.glob("shards/*"))) == 1


def killed_compaction(store):
    """Compact a store, but leave the originals; return the folder that replaces them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "discard", lambda *_: None)
        compact(store)
    (folder,) = store.shards()
    return folder


@pytest.mark.parametrize("name", ["trials.parquet", "episodes.parquet", "steps.parquet"])
def test_originals_outlive_a_killed_compaction_until_what_replaces_them_is_found_sound(tmp_path, name):
    store = small(tmp_path, shards=3)
    replacing = killed_compaction(store)
    originals = store.superseded()
    assert len(originals) == 3
    whole = (replacing / name).read_bytes()
    (replacing / name).write_bytes(whole[:200] + bytes([whole[200] ^ 1]) + whole[201:])
    store.commit("late", tables([100]))
    counts = compact(store)
    assert [(problem.shard, problem.file.name) for problem in counts.damaged] == [(replacing.name, name)]
    assert store.superseded() == originals and replacing.exists()
    store.quarantine(replacing.name)
    assert len(store.finished_trials()) == 7 and verify(store).problems == ()  # nothing is lost
    compact(store)
    assert (len(list(tmp_path.glob("shards/*"))), verify(store).trials) == (1, 7)


def test_originals_are_left_when_what_replaces_them_is_put_aside_meanwhile(tmp_path, monkeypatch):
    store = small(tmp_path, shards=3)
    replacing = killed_compaction(store)
    locked = Store.locked

    def put_aside_first(self):
        monkeypatch.setattr(Store, "locked", locked)
        Store.open(tmp_path).quarantine(replacing.name)
        return locked(self)

    monkeypatch.setattr(Store, "locked", put_aside_first)
    compact(store)
    assert len(store.finished_trials()) == 6 and verify(store).problems == ()


def test_originals_are_removed_under_the_lock(tmp_path, monkeypatch):
    store, held = small(tmp_path, shards=3), []
    discard = Store.discard

    def spy(self, shards):
        with open(tmp_path / ".lock", "a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                held.append(False)
            except BlockingIOError:
                held.append(True)
        discard(self, shards)

    killed_compaction(store)
    monkeypatch.setattr(Store, "discard", spy)
    store.commit("late", tables([100]))
    assert compact(store).shards_after == 1
    assert held == [True, True]  # what was left over, and what was put together now


def test_a_manifest_that_replaces_a_folder_outside_the_store_removes_nothing(tmp_path):
    store = small(tmp_path / "store", shards=1)
    precious = tmp_path / "precious"
    precious.mkdir()
    forged = store.path / "shards" / "c-0123"
    shutil.copytree(store.path / "shards" / "shard-0", forged)
    for name in ("../../precious", str(precious)):
        known = manifest.read(store.path / "shards" / "shard-0")
        dataclasses.replace(known, replaces=(name,)).write(forged)
        with pytest.raises(DamagedError, match=r"c-0123/manifest.json: is damaged: it replaces '.*precious', which can be no"):
            compact(store)
        assert precious.exists()


def test_a_compacted_shard_that_does_not_say_what_it_replaces_is_refused_rather_than_counted_twice(tmp_path):
    store = small(tmp_path)
    compact(store)
    (folder,) = store.shards()
    (folder / "manifest.json").write_text("{")
    for refused in (store.shards, store.finished_trials, lambda: compact(store)):
        with pytest.raises(DamagedError, match=r"manifest.json: is damaged"):
            refused()
    assert verify(store).problems[0].file == folder / "manifest.json"


def _look(path, stop, seen):
    store = Store.open(path)
    while not stop.is_set():
        seen.append(len(store.finished_trials()))
        seen.append(len(Store.open(path).finished_trials()))


def test_whoever_looks_on_sees_every_trial_and_a_launch_may_commit_meanwhile(tmp_path):
    store = small(tmp_path, shards=12)
    stop, seen = threading.Event(), []
    watcher = threading.Thread(target=_look, args=(tmp_path, stop, seen))
    watcher.start()
    try:
        for number in range(6):
            store.commit(f"meanwhile-{number}", tables([1000 + number]))
            compact(store, target_trials=8 + 4 * number)
    finally:
        stop.set()
        watcher.join()
    assert len(seen) > 6
    assert seen == sorted(seen) and seen[0] >= 24 and len(store.finished_trials()) == 30
    assert verify(store).problems == ()


def _compact(path):
    return compact(Store.open(path)).trials


def test_compactions_at_once_leave_each_trial_exactly_once(tmp_path):
    store = small(tmp_path, shards=8)
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        pool.map(_compact, [tmp_path] * 2, chunksize=1)
    compact(store)
    report = verify(store)
    assert (report.problems, report.trials, report.shards) == ((), 16, 1)


def test_a_shard_that_is_put_aside_meanwhile_does_not_come_back(tmp_path, monkeypatch):
    store = small(tmp_path)
    locked = Store.locked

    def put_aside_first(self):
        monkeypatch.setattr(Store, "locked", locked)
        Store.open(tmp_path).quarantine("shard-1")
        return locked(self)

    monkeypatch.setattr(Store, "locked", put_aside_first)
    assert compact(store).trials == 0
    assert len(store.finished_trials()) == 8
    assert trial(2).id not in store.finished_trials()


MEMORY = """
import resource, sys
from small_shards import tables
from sweep.compaction import compact
from sweep.store import Store

def store(path, trials):
    made = Store.create(path)
    for number in range(4):
        made.commit(f"s{number}", tables(range(trials * number, trials * (number + 1)), steps=100_000, length=1000))
    return made

compact(store(sys.argv[1] + "/small", 1))
large = store(sys.argv[1] + "/large", 64)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
assert compact(large).trials == 256
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_the_steps(tmp_path):
    """25.6 million rows, 300 MB."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support")])
    command = [sys.executable, "-c", MEMORY, str(tmp_path)]
    ran = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    assert int(ran.stdout) < 60
    (file,) = tmp_path.glob("large/shards/*/steps.parquet")
    metadata = pq.ParquetFile(file).metadata
    assert metadata.num_rows == 25_600_000
    assert {metadata.row_group(group).num_rows for group in range(metadata.num_row_groups)} == {100_000}
    assert "DELTA_BINARY_PACKED" in metadata.row_group(0).column(1).encodings
    assert file.stat().st_size / 256 < 16 * 100 + 1000  # bytes a trial: 16 an episode, and 1 kB
