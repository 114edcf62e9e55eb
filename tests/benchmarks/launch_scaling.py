"""What two cores gain over one through `sweep launch`, and what surrounds the training: Ray, Parquet, processes, scheduling.

    python tests/benchmarks/launch_scaling.py [--trials 768] [--steps 12000] [--slice 10] [--spare-core] [--in-turns 0] [--json F]

The same trials (Pendulum with continuous actions, three hidden layers of 64) are launched on one core, with one worker, and on
two cores, with two workers, each into a new store. All of a launch is on its cores: the command, Ray, the workers. Pilots run
before: what they find is kept for every later launch. `--spare-core` launches a third time, with one worker on two cores:
whatever is not training then has a core of its own.

A machine that others use, too, drifts by ten per cent from one minute to the next, more than what is to be measured. So the
launches alternate: every ten seconds one of them is frozen (SIGSTOP to all of its processes) and the next one goes on. Each is
timed by the slices it had, from its first process to the end of its last.

`--in-turns N` launches them N times one after the other instead, undisturbed, and says from the stores' own columns how much of
the workers' time was not training.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import NamedTuple

import pyarrow.parquet as pq

GRID = """
[study]
name = "scaling"
environments = ["Pendulum-CA"]
steps = {steps}
[seeds]
tune = {seeds}
[sweep]
critic_step_size = [1e-4, 3e-4, 1e-3]
actor_step_size_scale = [0.1, 1.0]
hidden_layers = [[64, 64, 64]]
[[agent]]
name = "{algorithm}"
"""
SETTINGS = 6
COMMAND = "from sweep.cli import main; main()"


class Where(NamedTuple):
    """How many workers a launch has, on how many cores."""

    workers: int
    cores: int


ONE_CORE, TWO_CORES, CORE_TO_SPARE = Where(1, 1), Where(2, 2), Where(1, 2)


class Launch:
    """`sweep launch` with all of its processes on so many cores: frozen and thawed together, timed while it is not frozen."""

    def __init__(self, folder: Path, where: Where, store: str) -> None:
        self.where, self.store, self.seconds = where, folder / store, 0.0
        arguments = ("launch", "grid.toml", "--yes", "--num-cpus", str(where.workers), "--store", store)
        confined = f"import os; os.sched_setaffinity(0, {cores()[: where.cores]}); {COMMAND}"  # what it starts inherits that
        self._output = open(folder / f"{store}.txt", "w+")  # noqa: SIM115  (it outlives this method)
        self._running_since: float | None = time.perf_counter()
        command = (sys.executable, "-c", confined, *arguments)
        self._process = subprocess.Popen(command, cwd=folder, stdout=self._output, stderr=self._output)

    def run(self, seconds: float | None = None) -> bool:
        """Go on for so long, or to the end; return whether it has ended. Raises SystemExit when it failed."""
        if self._running_since is None:
            self._running_since = time.perf_counter()
            self._signal(signal.SIGCONT)
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        ended = self._process.poll() is not None
        if not ended:
            self._signal(signal.SIGSTOP)
        self.seconds += time.perf_counter() - self._running_since
        self._running_since = None
        if self._process.returncode:
            self._output.seek(0)
            raise SystemExit(f"the launch with {self.where} failed:\n{self._output.read()}")
        return ended

    def kill(self) -> None:
        """End all of its processes, if there still are any."""
        if self._process.poll() is None:
            self._signal(signal.SIGKILL)

    def _signal(self, number: int) -> None:
        """Send a signal to all processes, again until no new one has come up meanwhile."""
        told: set[int] = set()
        while new := descendants(self._process.pid) - told:
            for process in new:
                with suppress(ProcessLookupError):
                    os.kill(process, number)
            told |= new

    def trials(self) -> dict[str, float]:
        """Return what the store says: trials, shards, agent-steps, seconds in training loops (frozen or not)."""
        tables = [pq.read_table(file) for file in sorted(self.store.rglob("trials.parquet"))]
        total = {name: sum(sum(table[name].to_pylist()) for table in tables) for name in ("steps", "wall_seconds")}
        return {
            "trials": sum(len(table) for table in tables),
            "shards": len(tables),
            "agent_steps": total["steps"],
            "training_seconds": total["wall_seconds"],
        }

    def report(self) -> dict[str, float]:
        """Return its workers, cores, seconds, agent-steps a second and what the store says."""
        found = self.trials()
        return {
            **self.where._asdict(),
            "seconds": self.seconds,
            "agent_steps_per_second": found["agent_steps"] / self.seconds,
            **found,
        }


def cores() -> list[int]:
    """Return the processors that this process may use, one of each core. Raises SystemExit when they are not two at least."""
    found: dict[str, int] = {}
    for processor in sorted(os.sched_getaffinity(0)):
        siblings = Path(f"/sys/devices/system/cpu/cpu{processor}/topology/thread_siblings_list")
        found.setdefault(siblings.read_text() if siblings.exists() else str(processor), processor)
    if len(found) < 2:
        raise SystemExit("this needs two cores")
    return list(found.values())


def descendants(ancestor: int) -> set[int]:
    """Return the processes that come from this one, itself included."""
    listed = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout.splitlines()
    parents = dict(map(int, line.split()) for line in listed)
    found, before = {ancestor}, 0
    while len(found) > before:
        before = len(found)
        found |= {process for process, parent in parents.items() if parent in found}
    return found


def interleaved(folder: Path, wheres: Sequence[Where], seconds: float) -> list[dict[str, float]]:
    """Launch once each, slice by slice; return a report of each."""
    launches, going = [], []
    try:
        for where in wheres:
            launches.append(Launch(folder, where, f"store-{where.workers}-{where.cores}"))
            going.append(launches[-1])
            if launches[-1].run(10.0):  # a Ray that starts is not to be frozen
                going.pop()
        while going:
            going = [launch for launch in going if not launch.run(seconds)]
    finally:
        for launch in launches:
            launch.kill()
    return [launch.report() for launch in launches]


def in_turns(folder: Path, wheres: Sequence[Where], times: int) -> list[dict[str, float]]:
    """Launch one after the other, then in the opposite order, …; return a report of each, with the share of training."""
    found = []
    for turn in range(times):
        for where in wheres if turn % 2 == 0 else wheres[::-1]:
            launch = Launch(folder, where, f"store-{where.workers}-{where.cores}-{turn}")
            launch.run()
            one = launch.report()
            found.append({**one, "around": 1 - one["training_seconds"] / (where.workers * one["seconds"])})
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=768)
    parser.add_argument("--steps", type=int, default=12_000)
    parser.add_argument("--slice", type=float, default=10.0, help="seconds before the other launch has its turn")
    parser.add_argument("--in-turns", type=int, default=0, metavar="N", help="so many times, one launch after the other")
    parser.add_argument("--spare-core", action="store_true", help="launch one worker on two cores, too")
    parser.add_argument("--algorithm", default="GreedyAC")
    parser.add_argument("--json", type=Path, help="write the results there too")
    arguments = parser.parse_args()
    seeds = max(1, arguments.trials // SETTINGS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "grid.toml").write_text(GRID.format(steps=arguments.steps, seeds=seeds, algorithm=arguments.algorithm))
        for workers in ("1", "2"):
            subprocess.run(
                [sys.executable, "-c", COMMAND, "plan", "grid.toml", "--num-cpus", workers],
                cwd=folder,
                stdout=subprocess.DEVNULL,
                check=True,
            )
        wheres = (ONE_CORE, TWO_CORES, *([CORE_TO_SPARE] if arguments.spare_core else []))
        times, slice_seconds = arguments.in_turns, arguments.slice
        found = in_turns(folder, wheres, times) if times else interleaved(folder, wheres, slice_seconds)
    for one in found:
        around = f", around training {one['around']:.1%}" if "around" in one else ""
        rate = f"{one['agent_steps_per_second']:,.0f} agent-steps/s"
        launched = f"workers: {one['workers']}, cores: {one['cores']}"
        print(f"{launched}, {one['seconds']:.1f} s, {rate}, {one['shards']} shards{around}")
    seconds = {where: [one["seconds"] for one in found if (one["workers"], one["cores"]) == where] for where in wheres}
    for where, name in ((ONE_CORE, "one core"), (CORE_TO_SPARE, "one worker with a core to spare")):
        if where in seconds:
            ratio = median(alone / both for alone, both in zip(seconds[where], seconds[TWO_CORES], strict=True))
            print(f"two cores {ratio:.3f} x {name}")
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
