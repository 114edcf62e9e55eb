"""The benchmark runs; what it measures is nobody's business here."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
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
        "--algorithms",
        "GreedyAC",
        "SAC",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run([*command, "--json", tmp_path / "speed.json"], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    rows = json.loads((tmp_path / "speed.json").read_text())
    assert {row["population"] for row in rows} == {"plain", 1, 2}
    assert {(row["algorithm"], row["environment"]) for row in rows} == {
        (algorithm, environment) for algorithm in ("GreedyAC", "SAC") for environment in ("Pendulum-CA", "Pendulum-DA")
    }
    assert all(row["agent_steps_per_second"] > 0 and row["times_plain"] > 0 and row["share_of_sgemm"] > 0 for row in rows)
    (greedy,) = {
        row["mflop_per_step"]
        for row in rows
        if row["environment"] == "Pendulum-CA" and row["algorithm"] == "GreedyAC" and len(row["hidden_layers"]) == 3
    }
    # 960 evaluations of the critic, five of 32 (actor twice, target, critic, proposal), three backward passes, one act
    critic, actor = 2 * (3 * 64 + 2 * 64 * 64 + 64), 2 * (2 * 64 + 2 * 64 * 64 + 64 * 2)
    by_hand = 960 * critic + 32 * (3 * actor + 2 * critic) + 2 * 32 * (critic + 2 * actor) + actor
    assert greedy == round(by_hand / 1e6, 2)


@pytest.mark.slow
def test_launches_on_one_worker_and_on_two_take_turns_to_their_ends(tmp_path):
    command = [sys.executable, "tests/benchmarks/launch_scaling.py", "--trials", "24", "--steps", "1000", "--slice", "2"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path)}
    ran = subprocess.run([*command, "--json", tmp_path / "found.json"], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    one, two = json.loads((tmp_path / "found.json").read_text())
    assert (one["workers"], two["workers"]) == (1, 2)
    assert one["trials"] == two["trials"] == 24
    assert one["agent_steps"] == two["agent_steps"] == 24_000
    assert f"{one['seconds'] / two['seconds']:.3f} x one" in ran.stdout
