"""What scheduling costs: a study of 57,600 trials that do nothing goes through plan, launch, status and resume.

    python tests/benchmarks/scheduling.py [--trials 57600] [--json FILE]

The trials are those of a function that returns at once. Beside them stands what as many trials of 100,000 steps would take to
train on as many workers, at the rate that `sweep plan` takes where nothing was measured.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from sweep.shards import NOMINAL_AGENT_STEPS_PER_SECOND

ROOT = Path(__file__).parent.parent.parent
FUNCTION = '''
def train(config, seed, report):
    """Take all steps at once."""
    report(float(seed), config["steps"])
'''
GRID = """
[study]
name = "trivial"
environments = ["Pendulum-CA"]
steps = 1_000
[seeds]
tune = 100
[sweep]
x = {{ range = [1, {settings}, 1] }}
[[agent]]
name = "trivial:train"
"""
STEPS = 100_000


def run(folder: Path, *arguments: str) -> dict[str, float]:
    """Run a command of `sweep`; return seconds, its largest memory in MB, and what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", "from sweep.cli import main; main()", *arguments]
    started = time.perf_counter()
    with open(folder / "output.txt", "w+") as output:
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=output)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - started
        output.seek(0)
        text = output.read()
    if os.waitstatus_to_exitcode(status):
        raise SystemExit(f"{arguments} failed:\n{text}")
    return {"seconds": seconds, "memory_mb": usage.ru_maxrss / 1024, "output": json.loads(text)}


def measure(trials: int, workers: int, folder: Path) -> dict[str, object]:
    """Return seconds and memory of each command, by name."""
    (folder / "trivial.py").write_text(FUNCTION)
    (folder / "grid.toml").write_text(GRID.format(settings=trials // 100))
    cpus = ("--num-cpus", str(workers))
    found = {
        "plan": run(folder, "plan", "grid.toml", "--no-pilot", "--json", *cpus),
        "launch": run(folder, "launch", "grid.toml", "--yes", "--json", *cpus),
        "status": run(folder, "status", "--json"),
        "launch again": run(folder, "launch", "grid.toml", "--yes", "--json", *cpus),
        "verify": run(folder, "verify", "--json"),
        "compact": run(folder, "compact", "--json"),
        "launch again, compacted": run(folder, "launch", "grid.toml", "--yes", "--json", *cpus),
    }
    assert found["launch"]["output"]["trained"] == trials
    assert found["launch again"]["output"]["finished"] == trials
    return {name: {key: value for key, value in one.items() if key != "output"} for name, one in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=57_600)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--json", type=Path, help="write the results there too")
    arguments = parser.parse_args()
    arguments.trials -= arguments.trials % 100
    with tempfile.TemporaryDirectory() as folder:
        found = measure(arguments.trials, arguments.workers, Path(folder))
    training = arguments.trials * STEPS / (NOMINAL_AGENT_STEPS_PER_SECOND * arguments.workers)
    print(f"{arguments.trials:,} trials, {arguments.workers} workers; to train them would take {training:,.0f} s")
    for name, one in found.items():
        share = one["seconds"] / training
        print(f"{name:24} {one['seconds']:9.2f} s ({share:.3%} of that), {one['memory_mb']:6,.0f} MB")
    if arguments.json:
        arguments.json.write_text(json.dumps({"training_seconds": training, **found}, indent=1))


if __name__ == "__main__":
    main()
