"""The command as a user runs it: messages, exit codes, and nothing written when the input is bad."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

GRID = """
[study]
name = "tiny"
environments = ["Pendulum-CA"]
steps = 60
cutoff = 25
[seeds]
tune = 2
[sweep]
critic_step_size = [0.01, 0.001]
entropy_scale = [0.1, 1]
[[agent]]
name = "SAC"
"""
ROOT = Path(__file__).parent.parent


def sweep(*arguments, cwd, stdin=""):
    """Run the command line in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    environment.pop("SWEEP_STORE", None)
    command = [sys.executable, "-c", "from sweep.cli import main; main()", *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, input=stdin, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with a finished study."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "grid.toml").write_text(GRID)
    ran = sweep("launch", "grid.toml", "--executor", "in-process", cwd=folder)
    assert ran.returncode == 0, ran.stderr
    assert "8 trials trained in" in ran.stdout
    assert "agent-steps a second" in ran.stdout
    return folder


def test_there_is_a_row_for_every_step_of_every_trial(finished):
    assert sweep("sql", "SELECT count(*) FROM steps", "--format", "csv", cwd=finished).stdout.split()[-1] == "480"
    query = "SELECT count(*) FROM (SELECT trial FROM episodes GROUP BY trial HAVING sum(length) = 60)"
    assert sweep("sql", "--format", "csv", cwd=finished, stdin=query).stdout.split()[-1] == "8"


def test_launching_again_says_that_there_is_nothing_to_do(finished):
    ran = sweep("launch", "grid.toml", cwd=finished)
    assert (ran.returncode, ran.stdout) == (0, "tiny: all 8 trials are finished; nothing to do.\n")


def test_launch_can_report_as_json(finished):
    import json

    answer = json.loads(sweep("launch", "grid.toml", "--json", cwd=finished).stdout)
    assert (answer["trials"], answer["finished"], answer["trained"]) == (8, 8, 0)


def test_figure_7_1_is_drawn(finished):
    ran = sweep("analyze", "--figure", "7.1", "--out", "figures", "--format", "png,csv", cwd=finished)
    assert ran.returncode == 0, ran.stderr
    assert (finished / "figures" / "figure-7.1.png").read_bytes().startswith(b"\x89PNG")
    assert "critic_step_size" in (finished / "figures" / "figure-7.1.csv").read_text()


BAD_GRIDS = [
    (("steps = 60", "stpes = 60"), 'grid.toml: study.stpes: unknown key; did you mean "steps"?'),
    (("[0.01, 0.001]", "[0.01, -0.001]"), "grid.toml: sweep.critic_step_size: value -0.001 must be greater than 0"),
    (("Pendulum-CA", "Pendulun-CA"), 'unknown environment; did you mean "Pendulum-CA"?'),
    (("[0.01, 0.001]", "[]"), "grid.toml: sweep.critic_step_size: nothing to sweep: the list of values is empty"),
    (("tune = 2", "tune = [0, 1]\nevaluate = [1, 2]"), "grid.toml: seeds.evaluate: overlaps with seeds.tune (1)"),
]


@pytest.mark.parametrize(("edit", "message"), BAD_GRIDS)
def test_a_bad_grid_is_refused_with_exit_code_1_and_nothing_is_written(tmp_path, edit, message):
    (tmp_path / "grid.toml").write_text(GRID.replace(*edit))
    ran = sweep("launch", "grid.toml", cwd=tmp_path)
    assert ran.returncode == 1
    assert message in ran.stderr
    assert "Traceback" not in ran.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["grid.toml"]


def test_a_folder_that_is_not_a_store_is_refused_by_every_command(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    for command in (["launch", "grid.toml"], ["sql", "SELECT 1"], ["analyze", "--figure", "7.1"]):
        ran = sweep(*command, "--store", "mine", cwd=tmp_path)
        assert (ran.returncode, ran.stdout) == (1, "")
        assert ran.stderr == "error: mine: is not a store: it has no readable sweep-store.json\n"
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("SELEC 1", "SELEC"),
        ("SELECT nothing FROM trials", "nothing"),
        ("DROP VIEW trials", "read-only"),
        ("SELECT 1; SELECT 2", "one"),
        ("", "empty"),
    ],
)
def test_sql_that_cannot_be_answered_is_a_message_and_exit_code_1(finished, query, message):
    ran = sweep("sql", query, cwd=finished)
    assert ran.returncode == 1
    assert message in ran.stderr
    assert "Traceback" not in ran.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["launch"], "Missing argument"),
        (["launch", "grid.toml", "--executor", "slurm"], "'slurm' is not one of 'ray', 'in-process'"),
        (["launch", "nowhere.toml"], "nowhere.toml: no such grid file"),
        (["lanch"], "lanch"),
        (["analyze"], "say which figure"),
        (["analyze", "--figure", "9.9"], "9.9"),
        (["analyze", "--figure", "7.1", "--format", "bmp"], "bmp"),
    ],
)
def test_bad_usage_is_exit_code_1(finished, arguments, message):
    ran = sweep(*arguments, cwd=finished)
    assert ran.returncode == 1
    assert message in ran.stderr
    assert "Traceback" not in ran.stderr


def test_help_answers_without_loading_torch_ray_or_duckdb():
    code = (
        "import sys; sys.argv = ['sweep', '--help']\n"
        "from sweep.cli import main\n"
        "try: main()\n"
        "except SystemExit as stop: assert stop.code == 0\n"
        "assert not {'torch', 'ray', 'duckdb', 'pandas', 'pyarrow', 'numpy'} & set(sys.modules)"
    )
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
