"""The benchmark runs; what it measures is nobody's business here."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_the_speed_benchmark_compares_populations_with_a_plain_agent(tmp_path):
    command = [
        sys.executable,
        "tests/benchmarks/training_speed.py",
        "--seconds",
        "0.05",
        "--turns",
        "1",
        "--populations",
        "1",
        "2",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run([*command, "--json", tmp_path / "speed.json"], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    rows = json.loads((tmp_path / "speed.json").read_text())
    assert {row["variant"] for row in rows} == {"plain single agent", "population of 1", "population of 2"}
    assert {row["algorithm"] for row in rows} == {"GreedyAC", "SAC"}
    assert all(row["agent_steps_per_second"] > 0 and row["times_plain"] > 0 for row in rows)
