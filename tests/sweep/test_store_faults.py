"""A commit when something fails: a full disk, one that may only be read, a killed process, a wrong clock."""

import errno
import os
import subprocess
import time

import pytest
from faults import Faults, Killed
from small_shards import rows, tables, trial

from sweep.files import UnwritableError
from sweep.messages import UserError
from sweep.store import Store
from sweep.tables import members_table
from sweep.verification import verify


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
