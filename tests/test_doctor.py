"""`sweep doctor` says what trains here."""

import json
import os
import subprocess
import sys
from pathlib import Path

import torch

from agents import kernels

ROOT = Path(__file__).parent.parent


def doctor(*arguments, cwd):
    command = [sys.executable, "-c", "from sweep.cli import main; main()", "doctor", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


def test_a_doctor_says_which_engine_trains_and_what_is_installed(tmp_path):
    found = json.loads(doctor("--json", cwd=tmp_path).stdout)
    assert found["engine"] == kernels.engine_name("cpu")
    assert found["cores"] == os.cpu_count()
    assert found["versions"]["torch"] == torch.__version__
    assert set(found["versions"]) >= {"python", "sweep", "torch", "numpy", "ray", "duckdb", "pyarrow", "gymnasium"}
    assert found["calibrations"] == os.path.join(os.environ["XDG_CACHE_HOME"], "sweep", "calibrations.json")
    shown = doctor(cwd=tmp_path).stdout
    for told in (
        found["engine"],
        found["engine_reason"],
        found["processor"],
        found["versions"]["pyarrow"],
        found["calibrations"],
    ):
        assert told in shown
    assert list(tmp_path.iterdir()) == []
