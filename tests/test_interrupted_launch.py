"""A launch that is interrupted, as a user does it: what is finished stays, and the exit code says so."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny_study import GRID

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_stops_the_workers_keeps_what_is_finished_and_gives_exit_code_3(tmp_path, how):
    long_trials = "\n[[agent]]\nname = 'GreedyAC'\nfixed = { batch_size = 31 }\n"
    (tmp_path / "grid.toml").write_text((GRID + long_trials).replace("steps = 60", "steps = 30_000"))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", "from sweep.cli import main; main()", "launch", "grid.toml", "--num-cpus", "2"]
    process = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True, start_new_session=True)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("results/.progress/*")) and time.monotonic() < deadline:
        time.sleep(0.2)
    os.kill(process.pid, how)
    if how == signal.SIGINT:  # the first one lets the workers go on to the end of their shards
        time.sleep(1)
        os.kill(process.pid, how)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 3
    assert "Interrupted. What is finished is in the store; launch again to go on." in output


def test_an_interrupt_while_everything_starts_gives_exit_code_3_too(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    for delay in (1.0, 2.0):
        command = [sys.executable, "-c", "from sweep.cli import main; main()", "launch", "grid.toml", "--num-cpus", "1"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
        time.sleep(delay)
        os.kill(process.pid, signal.SIGINT)
        output, errors = process.communicate(timeout=60)
        assert process.returncode == 3, (output, errors)
        assert b"Interrupted." in output + errors
