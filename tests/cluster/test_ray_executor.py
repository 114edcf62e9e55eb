"""The whole way through Ray on this machine: the results equal those of training in one process."""

import contextlib
import io
import os
import signal
import threading
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from rich.console import Console

from cluster.calibration import calibrate
from cluster.executor import InProcessExecutor
from cluster.launch import launch
from cluster.progress import Progress
from cluster.worker import Training
from sweep.grid import parse
from sweep.messages import UserError
from sweep.store import Store
from sweep.trials import expand

GRID = """
[study]
name = "tiny"
environments = ["Pendulum-CA", "MountainCar-CA"]
steps = {steps}
cutoff = 25
[seeds]
tune = 2
[sweep]
critic_step_size = [0.01, 0.001]
[[agent]]
name = "SAC"
"""


def rows(store, table, leave_out=()):
    """All rows of a table but for the columns that say when and where."""
    found = []
    for file in store.path.glob(f"shards/*/{table}.parquet"):
        for row in pq.read_table(file, partitioning=None).to_pylist():
            found.append(tuple((name, str(value)) for name, value in row.items() if name not in leave_out))
    return sorted(found)


def run(folder, start, steps=60):
    store = Store.create(folder)
    study = parse(GRID.format(steps=steps), "grid.toml")
    summary = launch(study.name, expand(study), store, start, Progress(Console(file=io.StringIO())))
    return store, summary


def start_ray():
    from cluster.ray_executor import RayExecutor

    return RayExecutor(num_cpus=2)


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_ray_and_one_process_give_the_same_rows(tmp_path):
    through_ray, summary = run(tmp_path / "ray", start_ray)
    assert (summary.trained, summary.failed) == (8, 0)
    in_process, _ = run(tmp_path / "process", InProcessExecutor)
    when_and_where = ("wall_seconds", "finished_at", "population")
    assert rows(through_ray, "trials", when_and_where) == rows(in_process, "trials", when_and_where)
    for table in ("episodes", "steps"):
        assert rows(through_ray, table) == rows(in_process, table)
    umask = os.umask(0)
    os.umask(umask)
    for file in (tmp_path / "ray").glob("shards/*/*.parquet"):
        assert file.stat().st_mode & 0o777 == 0o666 & ~umask
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
    token = Path.home() / ".ray" / "auth_token"
    assert not token.exists() or token.stat().st_mode & 0o077 == 0


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_function_runs_in_several_workers_at_once_and_what_it_raises_is_raised_here(tmp_path, monkeypatch):
    def meet(count):
        """Return this worker's number when `count` workers are here at once."""
        (tmp_path / str(os.getpid())).touch()
        deadline = time.monotonic() + 60
        while len(list(tmp_path.iterdir())) < count and time.monotonic() < deadline:
            time.sleep(0.05)
        return os.getpid()

    executor = start_ray()
    try:
        assert (executor.slots, executor.slots_on_a_machine) == (2, 2)
        workers = executor.gather(meet, 2, 2)
        assert len({*workers, os.getpid()}) == 3
        with pytest.raises(ZeroDivisionError):
            executor.gather(lambda number: 1 // number, 0, 2)
        monkeypatch.setattr("cluster.calibration._SIZES", (16,))
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        study = parse(GRID.format(steps=60), "grid.toml")
        known = calibrate(expand(study), executor, Training(), whatever_the_size=True)
        assert [group.environment for group in known.groups] == ["Pendulum-CA", "MountainCar-CA"]
        for calibrated in known.groups.values():
            assert calibrated.calibration.rates[16] > 0
            assert calibrated.calibration.base_bytes > 100e6
    finally:
        executor.close()


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_waiting_for_a_shard_ends_with_it_asks_ray_nothing_meanwhile_and_hears_every_interrupt(monkeypatch):
    heard, asked = [], []

    def nap(seconds, _umask):
        time.sleep(seconds)
        return seconds

    def interrupt_three_times():
        for number in range(3):
            os.kill(os.getpid(), signal.SIGINT)
            deadline = time.monotonic() + 1.0
            while len(heard) <= number and time.monotonic() < deadline:
                time.sleep(0.01)

    monkeypatch.setattr("cluster.ray_executor._run_shard", nap)
    before = signal.signal(signal.SIGINT, lambda number, _frame: heard.append(number))
    try:
        executor = start_ray()
        try:
            executor.submit(0.0)
            began = time.monotonic()
            assert executor.wait(60.0) == [0.0]
            assert time.monotonic() - began < 50.0
            executor.submit(60.0)
            monkeypatch.setattr("ray.wait", lambda _running, num_returns, timeout: asked.append(timeout) or ([], []))
            thread = threading.Thread(target=interrupt_three_times)
            thread.start()
            assert executor.wait(3.5) == []
            thread.join()
            assert len(heard) == 3
            assert asked == [0]
        finally:
            executor.close()
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("address", "message"), [("127.0.0.1:1", "no Ray cluster answers there"), ("nonsense", "must be HOST:PORT")]
)
def test_an_address_where_no_cluster_answers_is_refused_at_once(address, message):
    from cluster.ray_executor import check_address

    with pytest.raises(UserError, match=message):
        check_address(address)


def descendants(pid):
    """Process ids of the children of a process, and of theirs."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                parents[int(entry.name)] = int(entry.joinpath("stat").read_text().rpartition(")")[2].split()[1])
    found, new = set(), {pid}
    while new:
        found |= new
        new = {child for child, parent in parents.items() if parent in found} - found
    return found - {pid}


@pytest.mark.cluster
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_worker_that_is_killed_is_started_again_and_every_row_is_there_once(tmp_path):
    killed = []

    def kill_a_worker():
        while not killed:
            time.sleep(0.2)
            if not list((tmp_path / "ray" / ".progress").glob("*")):
                continue
            for pid in descendants(os.getpid()):
                with contextlib.suppress(OSError):
                    if b"ray::run_shard" in Path(f"/proc/{pid}/cmdline").read_bytes():
                        os.kill(pid, signal.SIGKILL)
                        killed.append(pid)
                        break

    thread = threading.Thread(target=kill_a_worker, daemon=True)
    thread.start()
    store, summary = run(tmp_path / "ray", start_ray, steps=3000)
    assert killed
    assert (summary.trained, summary.failed) == (8, 0)
    reference, _ = run(tmp_path / "process", InProcessExecutor, steps=3000)
    for table in ("episodes", "steps"):
        assert rows(store, table) == rows(reference, table)
