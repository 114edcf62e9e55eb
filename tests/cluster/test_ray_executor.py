"""The whole way through Ray on this machine: the results equal those of training in one process."""

import io
import os
import signal
import threading
import time

import pyarrow.parquet as pq
import pytest
from rich.console import Console

from cluster.executor import InProcessExecutor
from cluster.launch import launch
from cluster.progress import Progress
from sweep.grid import parse
from sweep.store import Store

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
    summary = launch(parse(GRID.format(steps=steps), "grid.toml"), store, start, Progress(Console(file=io.StringIO())))
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


@pytest.mark.cluster
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_worker_that_is_killed_is_started_again_and_every_row_is_there_once(tmp_path):
    import subprocess

    killed = []

    def kill_a_worker():
        while not killed:
            time.sleep(0.2)
            if not list((tmp_path / "ray" / ".progress").glob("*")):
                continue
            found = subprocess.run(["pgrep", "-f", "ray::run_shard"], capture_output=True, text=True).stdout.split()
            for pid in found[:1]:
                os.kill(int(pid), signal.SIGKILL)
                killed.append(pid)

    thread = threading.Thread(target=kill_a_worker, daemon=True)
    thread.start()
    store, summary = run(tmp_path / "ray", start_ray, steps=3000)
    assert killed
    assert (summary.trained, summary.failed) == (8, 0)
    reference, _ = run(tmp_path / "process", InProcessExecutor, steps=3000)
    for table in ("episodes", "steps"):
        assert rows(store, table) == rows(reference, table)
