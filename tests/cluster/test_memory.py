"""What a plan says of memory is what a worker takes: planned in one process, trained and measured in others."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
GRID = """
[study]
name = "memory"
environments = ["{environment}"]
steps = {steps}
[seeds]
tune = {trials}
[fixed]
hidden_layers = [16]
batch_size = 4
[[agent]]
name = "GreedyAC"
"""


def sweep(*arguments, cwd):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support")])}
    environment.pop("SWEEP_STORE", None)
    command = [sys.executable, "-c", "from sweep.cli import main; main()", *arguments, "--json"]
    ran = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=1800)
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("executor", [["--executor", "in-process"], ["--num-cpus", "2"]], ids=["in-process", "ray"])
@pytest.mark.parametrize(
    ("environment", "steps", "trials", "replay"),
    [("Pendulum-DA", 20_000, 192, 20_000 * 7 * 4), ("wide_environments:wide/Noise-v0", 3_000, 96, 3_000 * 503 * 4)],
    ids=["Pendulum", "wide observations"],
)
def test_the_peak_memory_of_a_shard_is_within_ten_per_cent_of_what_was_planned(
    tmp_path, environment, steps, trials, replay, executor
):
    (tmp_path / "grid.toml").write_text(GRID.format(environment=environment, steps=steps, trials=trials))
    plan = sweep("plan", "grid.toml", *executor, cwd=tmp_path)
    (group,) = plan["groups"]
    assert plan["memory_bytes"] > 200e6 + group["population"] * replay
    summary = sweep("launch", "grid.toml", *executor, cwd=tmp_path)
    print(f"{environment} {executor}: {group['population']} agents, planned {plan}, took {summary}")
    assert summary["trained"] == trials
    assert summary["peak_memory_bytes"] == pytest.approx(plan["memory_bytes"], rel=0.1)
