"""What two workers gain over one through `sweep launch`, and what surrounds the training: Ray, Parquet, processes, scheduling.

    python tests/benchmarks/launch_scaling.py [--trials 384] [--steps 10000] [--slice 10] [--in-turns 0] [--json FILE]

The same trials (Pendulum with continuous actions, three hidden layers of 64) are launched on one worker and on two, each into a
new store. Pilots run before: what they find is kept for every later launch.

A machine that others use, too, drifts by ten per cent from one minute to the next, more than what is to be measured. So the
launches alternate: every ten seconds one of them is frozen (SIGSTOP to all of its processes) and the other one goes on. Each is
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
from contextlib import suppress
from pathlib import Path
from statistics import median

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
COMMAND = (sys.executable, "-c", "from sweep.cli import main; main()")


class Launch:
    """`sweep launch` on so many workers, with all of its processes: frozen and thawed together, timed while it is not frozen."""

    def __init__(self, folder: Path, workers: int, store: str) -> None:
        self.workers, self.store, self.seconds = workers, folder / store, 0.0
        arguments = ("launch", "grid.toml", "--yes", "--num-cpus", str(workers), "--store", store)
        self._output = open(folder / f"{store}.txt", "w+")  # noqa: SIM115  (it outlives this method)
        self._running_since: float | None = time.perf_counter()
        self._process = subprocess.Popen([*COMMAND, *arguments], cwd=folder, stdout=self._output, stderr=self._output)

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
            raise SystemExit(f"the launch on {self.workers} workers failed:\n{self._output.read()}")
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
        """Return its workers, seconds, agent-steps a second and what the store says."""
        found = self.trials()
        return {
            "workers": self.workers,
            "seconds": self.seconds,
            "agent_steps_per_second": found["agent_steps"] / self.seconds,
            **found,
        }


def descendants(ancestor: int) -> set[int]:
    """Return the processes that come from this one, itself included."""
    listed = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout.splitlines()
    parents = dict(map(int, line.split()) for line in listed)
    found, before = {ancestor}, 0
    while len(found) > before:
        before = len(found)
        found |= {process for process, parent in parents.items() if parent in found}
    return found


def interleaved(folder: Path, seconds: float) -> list[dict[str, float]]:
    """Launch on one worker and on two, slice by slice; return a report of each."""
    launches, going = [], []
    try:
        for workers in (1, 2):
            launches.append(Launch(folder, workers, f"store-{workers}"))
            going.append(launches[-1])
            if launches[-1].run(10.0):  # a Ray that starts is not to be frozen
                going.pop()
        while going:
            going = [launch for launch in going if not launch.run(seconds)]
    finally:
        for launch in launches:
            launch.kill()
    return [launch.report() for launch in launches]


def in_turns(folder: Path, pairs: int) -> list[dict[str, float]]:
    """Launch on one worker, then on two, then on two, then on one, …; return a report of each, with the share of training."""
    found = []
    for turn in range(pairs):
        for workers in (1, 2) if turn % 2 == 0 else (2, 1):
            launch = Launch(folder, workers, f"store-{workers}-{turn}")
            launch.run()
            one = launch.report()
            found.append({**one, "around": 1 - one["training_seconds"] / (workers * one["seconds"])})
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=384)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--slice", type=float, default=10.0, help="seconds before the other launch has its turn")
    parser.add_argument("--in-turns", type=int, default=0, metavar="N", help="so many pairs, one launch after the other")
    parser.add_argument("--algorithm", default="GreedyAC")
    parser.add_argument("--json", type=Path, help="write the results there too")
    arguments = parser.parse_args()
    seeds = max(1, arguments.trials // SETTINGS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "grid.toml").write_text(GRID.format(steps=arguments.steps, seeds=seeds, algorithm=arguments.algorithm))
        for workers in ("1", "2"):
            subprocess.run(
                [*COMMAND, "plan", "grid.toml", "--num-cpus", workers], cwd=folder, stdout=subprocess.DEVNULL, check=True
            )
        found = in_turns(folder, arguments.in_turns) if arguments.in_turns else interleaved(folder, arguments.slice)
    for one in found:
        around = f", around training {one['around']:.1%}" if "around" in one else ""
        rate = f"{one['agent_steps_per_second']:,.0f} agent-steps/s"
        print(f"workers: {one['workers']}, {one['seconds']:.1f} s, {rate}, {one['shards']} shards{around}")
    alone, beside = ([one["seconds"] for one in found if one["workers"] == workers] for workers in (1, 2))
    print(f"two workers {median(a / b for a, b in zip(alone, beside, strict=True)):.3f} x one")
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
