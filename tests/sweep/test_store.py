import errno
import hashlib
import json
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from faults import Faults, Killed
from small_shards import rows, tables, trial

from sweep.files import UnwritableError
from sweep.messages import UserError
from sweep.store import Store
from sweep.tables import members_table
from sweep.verification import verify

ROOT = Path(__file__).parent.parent.parent


def test_what_is_committed_can_be_read_back_and_is_finished(tmp_path):
    store = Store.create(tmp_path / "store")
    committed = tables([0, 1])
    assert store.commit("shard-1", committed) == 2
    assert store.finished_trials() == set(committed.trials["trial"].to_pylist())
    assert rows(store.path, "episodes") == committed.episodes.to_pylist()
    assert rows(store.path, "steps") == [row for block in committed.steps_in_blocks(100) for row in block.to_pylist()]
    assert [row["trial"] for row in rows(store.path, "trials")] == committed.trials["trial"].to_pylist()
    assert not list((tmp_path / "store" / ".staging").iterdir())


def test_a_trial_is_never_there_twice_whichever_shard_it_comes_with(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard-1", tables([0, 1]))
    assert store.commit("shard-1", tables([0, 1])) == 0
    assert store.commit("shard-2", tables([1, 2])) == 1
    assert sorted(row["seed"] for row in rows(store.path, "trials")) == [0, 1, 2]
    assert len(rows(store.path, "steps")) == 3000


def _commit(arguments):
    path, shard, seeds = arguments
    return Store(path).commit(shard, tables(seeds))


def test_four_processes_that_commit_overlapping_shards_leave_each_trial_exactly_once(tmp_path):
    Store.create(tmp_path)
    work = [(tmp_path, f"shard-{i % 50}", [i % 50, (i + 7) % 50]) for i in range(200)]
    with multiprocessing.get_context("spawn").Pool(4) as pool:
        new = pool.map(_commit, work, chunksize=1)
    assert sum(new) == 50
    assert sorted(row["seed"] for row in rows(tmp_path, "trials")) == list(range(50))
    assert len(rows(tmp_path, "steps")) == 50_000
    report = verify(Store(tmp_path))
    assert (report.problems, report.trials) == ((), 50)


def test_a_commit_waits_for_another_one_to_end(tmp_path):
    store = Store.create(tmp_path)
    waiting = threading.Thread(target=Store.open(tmp_path).commit, args=("shard", tables([0])))
    with store.locked():
        waiting.start()
        waiting.join(0.5)
        assert waiting.is_alive() and store.finished_trials() == set()
    waiting.join()
    assert store.finished_trials() == {trial(0).id}


@pytest.mark.parametrize(
    ("error", "stride"),
    [
        pytest.param(errno.ENOSPC, 11, id="some calls, full"),
        pytest.param(None, 13, id="some calls, killed"),
        pytest.param(errno.ENOSPC, 1, id="full", marks=pytest.mark.slow),
        pytest.param(errno.EIO, 1, id="input-output error", marks=pytest.mark.slow),
        pytest.param(None, 1, id="killed", marks=pytest.mark.slow),
    ],
)
def test_whichever_call_of_a_commit_fails_all_of_it_is_there_or_nothing_and_it_can_be_repeated(tmp_path, error, stride):
    """One of the trials is there already, so that the shard is written twice."""
    at, kinds, faults = 1, set(), None
    while faults is None or faults.happened:
        path = tmp_path / str(at)
        store = Store.create(path)
        store.commit("first", tables([0]))
        store.record_failure("shard", [trial(1), trial(2)], "lost", "host", "gone")
        faults = Faults(path, at, error)
        with faults.installed():
            try:
                store.commit("shard", tables([0, 1, 2]))
                raised = None
            except (UnwritableError, Killed) as stopped:
                raised = stopped
        if isinstance(raised, UnwritableError):
            assert (raised.errno, str(raised)) == (error, f"{path}: cannot be written to: {os.strerror(error)}")
        report = verify(Store.open(path))
        assert (report.problems, report.trials in (1, 3)) == ((), True), faults.calls[-1]
        assert raised is not None or report.trials == 3
        assert Store.open(path).commit("shard", tables([0, 1, 2])) == 3 - report.trials
        report = verify(Store.open(path))
        assert (report.problems, report.trials) == ((), 3)
        assert sorted(row["seed"] for row in rows(path, "trials")) == [0, 1, 2]
        assert Store.open(path).failures() == []
        kinds |= set(faults.calls)
        at += stride
    assert kinds >= {"open", "mkdir", "write", "flush", "fsync", "rename", "unlink"}
    assert at > 40


def test_a_file_system_that_is_really_full_loses_nothing(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", disk], capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"a small file system cannot be mounted here: {mounted.stderr.strip()}")
    try:
        store = Store.create(disk / "store")
        try:
            for committed in range(1000):
                store.commit(f"shard-{committed}", tables([committed]))
        except UnwritableError as error:
            refusal = str(error)
        assert refusal == f"{disk / 'store'}: cannot be written to: No space left on device"
        assert 1 < committed < 100
        report = verify(Store.open(disk / "store"))
        assert (report.problems, report.trials) == ((), committed)
        assert not list(disk.glob("store/.staging/*"))
        subprocess.run(["mount", "-o", "remount,size=1m", disk], check=True)
        assert store.commit(f"shard-{committed}", tables([committed])) == 1
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


def test_a_store_that_may_only_be_read_says_so(tmp_path):
    path = tmp_path / "store"
    store = Store.create(path)
    store.commit("shard", tables([0]))
    mounted = subprocess.run(["mount", "--bind", path, path], capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"nothing can be mounted here: {mounted.stderr.strip()}")
    try:
        subprocess.run(["mount", "-o", "remount,bind,ro", path], check=True)
        for refused in (
            lambda: store.commit("other", tables([1])),
            store.check_writable,
            lambda: store.quarantine("shard"),
            lambda: store.write_study("study", "text", members_table("study", {"tune": [trial(0)]})),
        ):
            with pytest.raises(UnwritableError, match=r"store.*: Read-only file system") as refusal:
                refused()
            assert refusal.value.errno == errno.EROFS and isinstance(refusal.value, UserError)
        store.record_failure("shard", [trial(1)], "lost", "host", "gone")
        assert Store.open(path).finished_trials() == {trial(0).id}
        assert verify(store).problems == ()
    finally:
        subprocess.run(["umount", "-l", path], check=True)


def test_a_store_on_a_disk_that_may_only_be_read_says_so_where_nothing_can_be_mounted(tmp_path, monkeypatch):
    store = Store.create(tmp_path)

    def refuse(*_arguments, **_options):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(os, "mkdir", refuse)
    for refused in (lambda: store.commit("shard", tables([0])), store.check_writable):
        with pytest.raises(UnwritableError, match="cannot be written to: Read-only file system"):
            refused()


def test_a_clock_that_is_set_back_or_ahead_loses_nothing(tmp_path, monkeypatch):
    store = Store.create(tmp_path)
    store.commit("shard-1", tables([0]))
    left = tmp_path / ".staging" / "shard-2-host-1-abc"
    left.mkdir()
    now = time.time()
    for clock, remains in ((now - 10 * 365 * 86400, True), (1.0, True), (now + 3600, True), (now + 2 * 86400, False)):
        monkeypatch.setattr(time, "time", lambda clock=clock: clock)
        store.commit(f"shard-{clock}", tables([int(clock)]))
        assert verify(store).problems == ()
        assert (left in verify(store).leftovers) == (not remains)
        store.clean_up()
        assert left.exists() == remains
    assert len(Store.open(tmp_path).finished_trials()) == 5


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
    assert before[3] == ("fsync", "manifest.json")
    assert before[4][0] == "fsync" and before[4][1].startswith("shard-1-")
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
from small_shards import tables

store = Store.create(sys.argv[1])
store.commit("small", tables([0], steps=100_000, length=1000))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
large = tables(range(256), steps=100_000, length=1000)
assert store.commit("large", large) == 255
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def test_memory_does_not_grow_with_the_steps_that_are_committed(tmp_path):
    """25.6 million rows, 300 MB, written twice because one of the trials is there already."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support")])
    command = [sys.executable, "-c", MEMORY, str(tmp_path / "store")]
    ran = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    assert int(ran.stdout) < 100
    assert pq.ParquetFile(tmp_path / "store" / "shards" / "large" / "steps.parquet").metadata.num_rows == 25_500_000


def test_writing_the_same_study_again_touches_no_file(tmp_path):
    store = Store.create(tmp_path)
    members = members_table("study", {"tune": [trial(0)]})
    store.write_study("study", "text", members, ["study.steps=5"])
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "studies" / "study").iterdir()}
    store.write_study("study", "text", members, ["study.steps=5"])
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "studies" / "study").iterdir()} == before
    assert sorted(file.name for file in before) == ["grid.toml", "members.parquet", "overrides.json"]


def test_a_studys_grid_overrides_and_trials_are_read_as_they_were_written(tmp_path):
    store = Store.create(tmp_path)
    assert store.studies() == []
    members = members_table("study-b", {"tune": [trial(0), trial(1)], "evaluate": [trial(1), trial(2)]})
    store.write_study("study-b", 'name = "τ"\n', members, ("study.steps=5", "a=b"))
    store.write_study("study-a", "", members_table("study-a", {}))
    assert store.studies() == ["study-a", "study-b"]
    assert store.study_source("study-b") == ('name = "τ"\n', ("study.steps=5", "a=b"))
    assert store.study_trials("study-b") == {trial(seed).id for seed in (0, 1, 2)}
    assert store.study_trials("study-b", "evaluate") == {trial(seed).id for seed in (1, 2)}
    assert store.study_trials("study-a") == store.study_trials("study-c") == set()
    store.write_study("study-b", "", members)
    assert store.study_source("study-b") == ("", ())
    assert not (tmp_path / "studies" / "study-b" / "overrides.json").exists()


def test_an_unknown_study_is_a_users_mistake_and_the_nearest_is_named(tmp_path):
    store = Store.create(tmp_path)
    with pytest.raises(UserError, match='there is no study "x" in this store; it has no study yet'):
        store.study_source("x")
    store.write_study("entropy-scale", "", members_table("entropy-scale", {}))
    with pytest.raises(UserError, match='there is no study "entropy-scal" in this store; did you mean "entropy-scale"'):
        store.study_source("entropy-scal")
    (tmp_path / "studies" / "entropy-scale" / "overrides.json").write_text('{"a": 1}')
    with pytest.raises(UserError, match=r"entropy-scale: is damaged .*overrides.json is no list of texts"):
        store.study_source("entropy-scale")


def test_a_manifest_says_what_the_files_are(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard", tables([0, 1], evaluated=True))
    folder = tmp_path / "shards" / "shard"
    said = json.loads((folder / "manifest.json").read_text())
    found = {
        file.name: {
            "bytes": len(file.read_bytes()),
            "rows": pq.read_table(file, partitioning=None).num_rows,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
        for file in folder.glob("*.parquet")
    }
    assert (said["format"], said["files"], said["replaces"]) == (1, found, [])
    assert {name: entry["rows"] for name, entry in found.items()} == {
        "trials.parquet": 2,
        "episodes.parquet": 20,
        "evaluations.parquet": 8,
        "steps.parquet": 2000,
    }


def test_a_truncated_or_missing_file_is_named_before_anything_is_trained(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard", tables([0]))
    file = tmp_path / "shards" / "shard" / "steps.parquet"
    content = file.read_bytes()
    file.write_bytes(content[:-100])
    advice = "`sweep verify` says what else is, `sweep retry` trains it again"
    with pytest.raises(UserError) as error:
        Store.open(tmp_path).finished_trials()
    assert str(error.value) == f"{file}: is damaged: {len(content) - 100:,} bytes, {len(content):,} were written; {advice}"
    file.unlink()
    with pytest.raises(UserError) as error:
        Store.open(tmp_path).finished_trials()
    assert str(error.value) == f"{file}: is damaged: it is missing, {len(content):,} bytes were written; {advice}"
    assert store.commit("other", tables([1])) == 1  # which trials there are is known: nothing is lost meanwhile
    (file.parent / "trials.parquet").write_bytes(b"")
    with pytest.raises(UserError, match=r"trials.parquet: is damaged"):
        Store.open(tmp_path).commit("third", tables([0, 2]))


def test_a_store_from_before_there_were_manifests_is_read(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard", tables([0]))
    (tmp_path / "shards" / "shard" / "manifest.json").unlink()
    assert Store.open(tmp_path).finished_trials() == {trial(0).id}
    assert Store.open(tmp_path).commit("other", tables([0, 1])) == 1


def test_the_rest_of_a_shard_comes_after_its_first_part_under_a_name_of_its_own(tmp_path):
    """A worker given up for dead commits the whole of a shard, of which another one had only the last trial to commit."""
    store = Store.create(tmp_path)
    store.commit("shard", tables([0]))
    assert store.commit("shard", tables([0, 1])) == 1
    assert [folder.name[:6] for folder in store.shards()] == ["shard", "shard-"]
    assert store.finished_trials() == {trial(0).id, trial(1).id}


def test_a_shard_put_aside_is_missing_and_can_be_committed_again(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard", tables([0]))
    store.commit("other", tables([1]))
    assert store.finished_trials() == {trial(0).id, trial(1).id}
    target = store.quarantine("shard")
    assert target.parent == tmp_path / ".quarantine" and (target / "trials.parquet").exists()
    assert store.finished_trials() == {trial(1).id}
    assert store.commit("shard", tables([0, 2])) == 2
    assert store.finished_trials() == {trial(seed).id for seed in (0, 1, 2)}
    assert store.quarantine("shard") != target
    for name in ("shard", "../studies", "."):
        with pytest.raises(UserError, match="there is no shard"):
            store.quarantine(name)


def test_a_store_is_opened_if_there_is_one(tmp_path):
    assert Store.open_if_any(tmp_path / "missing") is None
    assert Store.open_if_any(tmp_path) is None
    Store.create(tmp_path)
    assert Store.open_if_any(tmp_path).path == tmp_path
    (tmp_path / "sweep-store.json").unlink()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(UserError, match="is not a store"):
        Store.open_if_any(tmp_path)


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
