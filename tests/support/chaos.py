"""Launches that are killed: SIGKILL to a worker, the raylet, Ray's head, the driver, or all of them, at random moments."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq

from sweep.store import Store

ROOT = Path(__file__).parent.parent.parent
WHEN_AND_WHERE = ("wall_seconds", "finished_at", "population", "selected_at")
GRID = """
[study]
name = "chaos"
environments = ["Pendulum-CA", "MountainCar-DA"]
steps = 1_500
cutoff = 200
[seeds]
tune = 4
evaluate = 2
[sweep]
critic_step_size = [0.01, 0.001]
[[agent]]
name = "SAC"
[[agent]]
name = "GreedyAC"
"""


def command(*arguments: str) -> list[str]:
    """Return a command line of `sweep` in a process of its own."""
    return [sys.executable, "-c", "from sweep.cli import main; main()", *arguments]


def environment() -> dict[str, str]:
    """Return the environment variables for it."""
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def contents(store: Path) -> dict[str, list[tuple[tuple[str, str], ...]]]:
    """Return all rows of a store's tables, sorted, but for the columns that say when and where."""
    shards = Store.open(store).shards()
    files = {name: [folder / f"{name}.parquet" for folder in shards] for name in ("trials", "episodes", "steps")}
    for name in ("members", "selections"):
        files[name] = sorted(store.glob(f"studies/*/{name}.parquet"))
    found = {}
    for name, paths in files.items():
        rows = [row for file in paths for row in pq.read_table(file, partitioning=None).to_pylist()]
        found[name] = sorted(
            tuple((column, str(value)) for column, value in row.items() if column not in WHEN_AND_WHERE) for row in rows
        )
    return found


def family(pid: int) -> dict[int, str]:
    """Return pid → command line of all descendants of a process."""
    parents: dict[int, int] = {}
    names: dict[int, str] = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                stat = (folder / "stat").read_text()
                names[int(folder.name)] = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            parents[int(folder.name)] = int(stat[stat.rindex(")") + 2 :].split()[1])
    found: dict[int, str] = {}
    grown = [pid]
    while grown:
        grown = [child for child, parent in parents.items() if parent in grown and child not in found]
        found |= {child: names.get(child, "") for child in grown}
    return found


def kill(pids: Iterator[int] | list[int]) -> None:
    """Kill processes that may be gone already."""
    for pid in pids:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue


TARGETS = {"worker": "ray::run_shard", "raylet": "raylet/raylet ", "head": "gcs_server"}


class Chaos:
    """Launches a study again and again, and kills something at random moments until it has killed `kills` times."""

    def __init__(self, folder: Path, seed: int, kills: int, longest: float = 6.0) -> None:
        self.folder, self.random, self.left, self.longest = folder, random.Random(seed), kills, longest
        self.killed: dict[str, int] = {}
        self.launches = 0
        self.relatives: set[int] = set()
        (folder / "grid.toml").write_text(GRID)

    def run(self, store: Path) -> None:
        """Bring the study to its end in a store, with kills on the way as long as there are any left."""
        while True:
            self.launches += 1
            with open(self.folder / "errors.txt", "a") as errors:
                launch = subprocess.Popen(
                    command("launch", "grid.toml", "--store", str(store), "--num-cpus", "2", "--checkpoint-every", "0.3"),
                    cwd=self.folder,
                    env=environment(),
                    stdout=subprocess.DEVNULL,
                    stderr=errors,
                    start_new_session=True,
                )
            while self.left and launch.poll() is None:
                try:
                    launch.wait(self.random.uniform(0.0, self.longest))
                except subprocess.TimeoutExpired:
                    self._kill_something(launch)
            try:
                code = launch.wait(300)
            except subprocess.TimeoutExpired:
                kill([*family(launch.pid), launch.pid])
                raise
            if self.random.random() < 0.5:  # else whatever lives on without a driver may write what it likes
                kill(list(self.relatives))
            if code == 0:
                return

    def _kill_something(self, launch: "subprocess.Popen[bytes]") -> None:
        relatives = family(launch.pid)
        self.relatives |= relatives.keys()
        choice = self.random.choice(["worker", "worker", "raylet", "head", "driver", "all"])
        marker = TARGETS.get(choice)
        victims = [pid for pid, name in relatives.items() if marker and marker in name]
        if choice == "driver" or choice == "all":
            victims = [launch.pid, *(relatives if choice == "all" else ())]
        elif choice == "worker" and victims:
            victims = [self.random.choice(victims)]
        if not victims:
            return  # not there yet
        kill(victims)
        self.killed[choice] = self.killed.get(choice, 0) + 1
        self.left -= 1
        if choice in ("raylet", "head"):
            self._let_it_notice(launch)

    def _let_it_notice(self, launch: "subprocess.Popen[bytes]") -> None:
        """A driver without a Ray ends, or waits for it to come back: then it is killed, too."""
        try:
            launch.wait(self.random.uniform(0.0, 10.0))
        except subprocess.TimeoutExpired:
            relatives = family(launch.pid)
            self.relatives |= relatives.keys()
            kill([launch.pid])

    def clean_up(self) -> None:
        """Kill whatever is left of all launches."""
        kill(list(self.relatives))
        time.sleep(0.2)
