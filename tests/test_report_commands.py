"""`sweep report` and `sweep export` as a user runs them."""

import json
import subprocess
import sys

import pytest
from synthetic_store import SyntheticStore


def run(*arguments, cwd):
    command = [sys.executable, "-c", "from sweep.cli import main; main()", *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)


def test_the_command_writes_a_page_and_says_what_to_know(tmp_path):
    store = SyntheticStore(tmp_path / "results")
    store.plan("demo", "SAC", "Pendulum-CA", 0)
    store.write_studies()
    ran = run("report", cwd=tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert "warning: No run is finished: None of 1 trial" in ran.stdout
    assert ran.stdout.endswith("wrote report.html\n")
    assert "</html>" in (tmp_path / "report.html").read_text("utf-8")


def test_the_command_prints_json_and_writes_no_page(tmp_path):
    store = SyntheticStore(tmp_path / "results")
    store.plan("demo", "SAC", "Pendulum-CA", 0)
    store.write_studies()
    ran = run("report", "demo", "--json", cwd=tmp_path)
    assert json.loads(ran.stdout)["study"] == "demo"
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["report"], "several studies; say which: one, two"),
        (["report", "tow"], 'unknown study "tow"; did you mean "two"'),
        (["report", "one", "--out", "results/report.html"], "is in the store"),
        (["report", "one", "--store", "nowhere"], "there is no store here"),
        (["export", "tow"], 'unknown study "tow"; did you mean "two"'),
        (["export", "--out", "results/x"], "is in the store"),
    ],
)
def test_a_mistake_is_answered_in_a_line_with_exit_code_one(arguments, message, tmp_path):
    store = SyntheticStore(tmp_path / "results")
    for study in ("one", "two"):
        store.plan(study, "SAC", "Pendulum-CA", 0)
    store.write_studies()
    ran = run(*arguments, cwd=tmp_path)
    assert (ran.returncode, ran.stdout) == (1, "")
    assert message in ran.stderr
    assert "Traceback" not in ran.stderr
