"""The command as a user runs it: messages, exit codes, and nothing written when the input is bad."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_study import GRID

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


@pytest.mark.parametrize("comment", ["-- all of them\n", "--all of them, a = 1\n", "--\n"])
def test_a_query_may_begin_with_a_comment(finished, comment):
    asked = sweep("sql", "--format=csv", "--store", "results", f"{comment}SELECT 41 + 1 AS answer", cwd=finished)
    assert asked.stdout.split() == ["answer", "42"], asked.stderr


def test_launching_again_says_that_there_is_nothing_to_do(finished):
    ran = sweep("launch", "grid.toml", cwd=finished)
    assert (ran.returncode, ran.stdout) == (0, "tiny: all 8 trials are finished; nothing to do.\n")


def test_launch_can_report_as_json(finished, tmp_path):
    answer = json.loads(sweep("launch", "grid.toml", "--json", cwd=finished).stdout)
    assert (answer["trials"], answer["finished"], answer["trained"], answer["peak_memory_bytes"]) == (8, 8, 0, 0)
    (tmp_path / "grid.toml").write_text(GRID)
    answer = json.loads(sweep("launch", "grid.toml", "--json", "--executor", "in-process", cwd=tmp_path).stdout)
    assert answer["trained"] == 8
    assert 100e6 < answer["peak_memory_bytes"] < 4e9


def snapshot(folder):
    return {file: (file.stat().st_mtime_ns, file.is_file() and file.read_bytes()) for file in folder.rglob("*")}


CONTRACT = {"trials", "finished", "missing", "steps", "core_hours", "bytes"}
ADDITIONS = {"memory_bytes", "machine_memory_bytes", "groups", "hours", "engine"}


def test_a_plan_measures_says_what_a_launch_would_do_and_writes_nothing(tmp_path, tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("nothing-measured-yet")))
    (tmp_path / "grid.toml").write_text(GRID)
    ran = sweep("plan", "grid.toml", "--executor", "in-process", "--json", cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    assert set(found) >= CONTRACT | ADDITIONS
    assert (found["trials"], found["finished"], found["missing"], found["steps"]) == (8, 0, 8, 480)
    (group,) = found["groups"]
    assert group["rate"].startswith("measured in ")
    assert found["core_hours"] == pytest.approx(480 / group["agent_steps_per_second"] / 3600, abs=1e-4)
    assert 100e6 < found["memory_bytes"] == found["machine_memory_bytes"] < 4e9
    assert [file.name for file in tmp_path.iterdir()] == ["grid.toml"]
    again = json.loads(sweep("plan", "grid.toml", "--executor", "in-process", "--json", cwd=tmp_path).stdout)
    assert again["groups"][0]["rate"] == "measured before"
    assert again["groups"][0]["agent_steps_per_second"] == group["agent_steps_per_second"]


def test_a_plan_under_ray_is_for_its_slots(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    found = json.loads(sweep("plan", "grid.toml", "--num-cpus", "2", "--json", cwd=tmp_path).stdout)
    assert (found["slots"], found["shards"], found["groups"][0]["population"]) == (2, 2, 4)
    assert found["machine_memory_bytes"] == 2 * found["memory_bytes"]
    assert [file.name for file in tmp_path.iterdir()] == ["grid.toml"]


def test_a_plan_counts_what_is_finished_and_leaves_the_store_as_it_is(finished, tmp_path):
    shutil.copytree(finished / "results", tmp_path / "results")
    (tmp_path / "grid.toml").write_text(GRID.replace("tune = 2", "tune = 5"))
    before = snapshot(tmp_path)
    ran = sweep("plan", "grid.toml", "--no-pilot", "--num-cpus", "3", cwd=tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert "tiny: 20 trials, 8 finished, 12 missing: 720 agent-steps in 3 shards on 3 workers, engine " in ran.stdout
    assert "Nominal rates are guesses" in ran.stdout
    assert "\x1b" not in ran.stdout
    ran = sweep("plan", str(finished / "grid.toml"), cwd=tmp_path)
    assert ran.stdout == "tiny: all 8 trials are finished; nothing to do.\n"
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("store", ["nowhere", "empty"])
def test_a_plan_takes_a_store_that_is_not_there_for_an_empty_one(tmp_path, store):
    (tmp_path / "grid.toml").write_text(GRID)
    (tmp_path / "empty").mkdir()
    ran = sweep("plan", "grid.toml", "--store", store, "--no-pilot", cwd=tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert "8 trials, 0 finished, 8 missing" in ran.stdout
    assert sorted(file.name for file in tmp_path.rglob("*")) == ["empty", "grid.toml"]


@pytest.mark.parametrize(
    "command", [["launch", "grid.toml"], ["plan", "grid.toml"], ["plan", "grid.toml", "--no-pilot"], ["doctor"]]
)
def test_an_engine_that_does_not_exist_is_one_message_before_anything_is_written(tmp_path, monkeypatch, command):
    (tmp_path / "grid.toml").write_text(GRID)
    monkeypatch.setenv("SWEEP_ENGINE", "fortran")
    ran = sweep(*command, cwd=tmp_path)
    assert (ran.returncode, ran.stdout) == (1, "")
    (message,) = ran.stderr.splitlines()
    assert message.startswith("error: SWEEP_ENGINE = fortran: must be one of auto, native, torch")
    assert [file.name for file in tmp_path.iterdir()] == ["grid.toml"]


def test_figure_7_1_is_drawn(finished):
    ran = sweep("analyze", "--figure", "7.1", "--out", "figures", "--format", "png,csv", cwd=finished)
    assert ran.returncode == 0, ran.stderr
    assert (finished / "figures" / "figure-7.1.png").read_bytes().startswith(b"\x89PNG")
    assert "critic_step_size" in (finished / "figures" / "figure-7.1.csv").read_text()


def test_several_figures_and_tables_are_made_at_once_and_each_says_its_name(finished):
    ran = sweep(
        *("analyze", "--figure", "learning-curve", "--figure", "2.1", "--table", "tuned-settings", "--out", "several"),
        *("--format", "svg,csv,sql", "--agent", "SAC", "--band", "none"),
        cwd=finished,
    )
    assert (ran.returncode, "takes no --agent" in ran.stderr) == (1, True)
    arguments = ("--figure", "learning-curve", "--figure", "2.1", "--table", "tuned-settings", "--format", "svg,csv,sql")
    ran = sweep("analyze", *arguments, "--out", "several", cwd=finished)
    assert ran.returncode == 0, ran.stderr
    assert {file.name for file in (finished / "several").iterdir()} == {
        *(f"figure-learning-curve.{suffix}" for suffix in ("svg", "csv", "sql")),
        *(f"figure-2.1.{suffix}" for suffix in ("svg", "csv")),
        *(f"table-tuned-settings.{suffix}" for suffix in ("csv", "sql")),
    }
    lines = ran.stdout.splitlines()
    assert [line for line in lines if line.startswith(("figure ", "table "))] == [
        "figure learning-curve of study tiny",
        "figure 2.1",
        "table tuned-settings of study tiny",
    ]
    assert sum(line.startswith("wrote several/") for line in lines) == 7


def test_all_leaves_out_what_there_is_no_data_for_and_list_names_everything(finished):
    ran = sweep("analyze", "--all", "--out", "all", "--format", "csv", cwd=finished)
    assert ran.returncode == 0, ran.stderr
    assert "figure 3.1: left out: " in ran.stdout
    assert {"figure-learning-curve.csv", "table-best-returns.csv"} <= {file.name for file in (finished / "all").iterdir()}
    listed = sweep("analyze", "--list", cwd=finished).stdout.splitlines()
    assert (listed[0], listed[listed.index("") + 1]) == ("figures", "tables")
    assert {line.split()[0] for line in listed if line} >= {
        "2.1",
        "7.2",
        "A.4",
        "learning-curve",
        "seed-spread",
        "tuned-settings",
    }


def test_a_demonstration_needs_no_store(tmp_path):
    ran = sweep("analyze", "--figure", "4.2", cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["figure-4.2.png"]


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
    for command in ("launch", "plan"):
        ran = sweep(command, "grid.toml", cwd=tmp_path)
        assert ran.returncode == 1
        assert message in ran.stderr
        assert "Traceback" not in ran.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["grid.toml"]


def test_a_folder_that_is_not_a_store_is_refused_by_every_command(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    for command in (["launch", "grid.toml"], ["plan", "grid.toml"], ["sql", "SELECT 1"], ["analyze", "--figure", "7.1"]):
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
        (["plan"], "Missing argument"),
        (["plan", "nowhere.toml"], "nowhere.toml: no such grid file"),
        (["plan", "grid.toml", "--address", "127.0.0.1:1"], "no Ray cluster answers there"),
        (["plan", "grid.toml", "--address", "127.0.0.1:1", "--num-cpus", "2"], "plan: --address is for a Ray cluster"),
        (["plan", "grid.toml", "--address", "127.0.0.1:1", "--no-pilot"], "plan: --no-pilot asks no cluster"),
        (["analyze"], "say which figure"),
        (["analyze", "--figure", "9.9"], "9.9"),
        (["analyze", "--figure", "7.1", "--format", "bmp"], "bmp"),
        (["analyze", "--figure", "learning-curves"], 'did you mean "learning-curve"'),
        (["analyze", "--table", "A.9"], 'unknown table "A.9"'),
        (["analyze", "--figure", "learning-curve", "--study", "tinny"], 'did you mean "tiny"'),
        (["analyze", "--figure", "learning-curve", "--score", "final_mean"], "takes no --score; it takes: --by"),
        (["analyze", "--figure", "learning-curve", "--band", "sd"], 'unknown band "sd"'),
        (["analyze", "--figure", "learning-curve", "--over", "polyac"], 'did you mean "polyak"'),
        (["analyze", "--figure", "3.1"], "no study has data for it yet"),
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


def test_a_store_that_cannot_be_written_to_is_a_mistake_before_anything_is_trained(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    assert sweep("launch", "grid.toml", "--executor", "in-process", "--limit", "1", cwd=tmp_path).returncode == 3
    (tmp_path / "results" / ".staging").rmdir()
    (tmp_path / "results" / ".staging").write_text("in the way")
    ran = sweep("launch", "grid.toml", "--executor", "in-process", cwd=tmp_path)
    assert ran.returncode == 1
    assert ran.stderr.startswith("error: results: ")
    assert "Traceback" not in ran.stderr


def test_what_the_system_refuses_is_a_message_too(finished, tmp_path):
    ran = sweep("analyze", "--figure", "7.1", "--out", "grid.toml", cwd=finished)
    assert (ran.returncode, ran.stderr) == (1, "error: grid.toml: is a file; --out names a folder\n")
    shutil.copytree(finished / "results", tmp_path / "results")
    (file,) = list(tmp_path.glob("results/shards/*/trials.parquet"))[:1]
    file.write_bytes(file.read_bytes()[:100])
    for command in (
        ["launch", str(finished / "grid.toml")],
        ["plan", str(finished / "grid.toml")],
        ["analyze", "--figure", "7.1"],
        ["sql", "FROM trials"],
    ):
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
