"""The command as a user runs it: messages, exit codes, and nothing written when the input is bad."""

import os
import shutil
import signal
import subprocess
import sys
import time
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


def test_evaluation_episodes_are_a_table_of_their_own(finished, tmp_path):
    assert sweep("sql", "SELECT count(*) FROM evaluations", "--format", "csv", cwd=finished).stdout.split()[-1] == "0"
    (tmp_path / "grid.toml").write_text(GRID.replace("cutoff = 25", "cutoff = 25\nevaluation = { every = 20, episodes = 2 }"))
    assert sweep("launch", "grid.toml", "--executor", "in-process", cwd=tmp_path).returncode == 0
    query = "SELECT count(*), count(DISTINCT trial), sum(length) FROM evaluations"
    assert sweep("sql", query, "--format", "csv", cwd=tmp_path).stdout.split()[-1] == "48,8,1200"
    assert not {file.name for file in tmp_path.glob("results/shards/*")} & {
        file.name for file in finished.glob("results/shards/*")
    }


def test_a_limit_leaves_the_study_incomplete_with_exit_code_3(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    ran = sweep("launch", "grid.toml", "--executor", "in-process", "--limit", "3", cwd=tmp_path)
    assert (ran.returncode, "3 of 8 finished" in ran.stdout) == (3, True)
    ran = sweep("analyze", "--figure", "7.1", cwd=tmp_path)
    assert ran.returncode == 0
    assert "SAC on Pendulum-CA: 3 of 8 trials" in ran.stdout


def test_trials_that_cannot_be_written_are_failures_with_exit_code_2(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    assert sweep("launch", "grid.toml", "--executor", "in-process", "--limit", "1", cwd=tmp_path).returncode == 3
    (tmp_path / "results" / ".staging").rmdir()
    (tmp_path / "results" / ".staging").write_text("in the way")
    ran = sweep("launch", "grid.toml", "--executor", "in-process", cwd=tmp_path)
    assert ran.returncode == 2
    assert "7 trials failed" in ran.stdout
    assert "NotADirectoryError" in ran.stdout or "FileExistsError" in ran.stdout


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
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 3
    assert "Interrupted. What is finished is in the store; launch again to go on." in output


def test_an_interrupt_while_everything_starts_gives_exit_code_3_too(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    for delay in (0.3, 1.5):
        command = [sys.executable, "-c", "from sweep.cli import main; main()", "launch", "grid.toml", "--num-cpus", "1"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
        time.sleep(delay)
        os.kill(process.pid, signal.SIGINT)
        output, errors = process.communicate(timeout=60)
        assert process.returncode == 3, (output, errors)
        assert b"Interrupted." in output + errors


def test_what_the_system_refuses_is_a_message_too(finished, tmp_path):
    ran = sweep("analyze", "--figure", "7.1", "--out", "grid.toml", cwd=finished)
    assert (ran.returncode, ran.stderr) == (1, "error: grid.toml: the figure cannot be written there: File exists\n")
    shutil.copytree(finished / "results", tmp_path / "results")
    (file,) = list(tmp_path.glob("results/shards/*/trials.parquet"))[:1]
    file.write_bytes(file.read_bytes()[:100])
    for command in (["launch", str(finished / "grid.toml")], ["analyze", "--figure", "7.1"], ["sql", "FROM trials"]):
        ran = sweep(*command, cwd=tmp_path)
        assert ran.returncode == 1
        assert "trials.parquet" in ran.stderr
        assert "Traceback" not in ran.stderr


def test_an_answer_may_be_cut_short_by_its_reader(finished):
    code = "from sweep.cli import main; main()"
    command = f"{sys.executable} -c '{code}' sql 'FROM steps' --format csv | head -n 1"
    ran = subprocess.run(
        command, shell=True, cwd=finished, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert (ran.stdout, ran.stderr) == ("trial,step,episodic_return\n", "")


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
