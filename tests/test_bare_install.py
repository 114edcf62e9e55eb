"""Machines with little installed: training needs torch and numpy, a launch in one process four packages more.

Each command runs in a process whose imports of every other package fail, as they do where it is not installed.
"""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from analysis import connect
from sweep.store import Store

ROOT = Path(__file__).parent.parent
DECLARED = {re.split(r"\W", name)[0] for name in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]}
TRAINING = {"torch", "numpy"}
LAUNCHING = TRAINING | {"pyarrow", "pydantic", "typer", "rich"}
EVERYTHING = DECLARED | {"scipy", "stable_baselines3"}

BLOCKER = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {blocked!r}:
            raise ModuleNotFoundError("No module named " + repr(name), name=name)

assert not {blocked!r} & set(sys.modules), "imported at the start, before it could be blocked"
sys.meta_path.insert(0, Blocker())
"""
TRAIN = """
import agents
from agents.registry import ALGORITHMS, ENVIRONMENTS

pairs = [(a, e) for a in ALGORITHMS.values() for e in ENVIRONMENTS.values() if e.actions in a.actions]
for algorithm, environment in pairs:
    hypers = [algorithm.hypers(batch_size=4)] * 2
    records = agents.train(algorithm.name, environment.name, hypers, [0, 1], steps=12, cutoff=5)
    assert records.length.tolist() == [5, 5, 2] * 2, (algorithm.name, environment.name)
print(len(pairs))
"""
SWEEP = "from sweep.cli import main; main()"
GRID = """
[study]
name = "tiny"
environments = ["Pendulum-CA", "MountainCar-DA"]
steps = 60
cutoff = 25
evaluation = { every = 30, episodes = 1 }
[seeds]
tune = 2
[sweep]
critic_step_size = [0.01, 0.001]
[[agent]]
name = "SAC"
[[agent]]
name = "GreedyAC"
"""
TRIALS = 16


def python(code, *arguments, cwd, without=frozenset()):
    """Run code in a process of its own, without some packages."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    environment.pop("SWEEP_STORE", None)
    command = [sys.executable, "-c", BLOCKER.format(blocked=set(without)) + code, *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a study that was launched where only the packages for it are installed, and what the launch printed."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "grid.toml").write_text(GRID)
    ran = python(SWEEP, "launch", "grid.toml", "--executor", "in-process", cwd=folder, without=EVERYTHING - LAUNCHING)
    return folder, ran


def test_the_packages_that_are_blocked_cannot_be_imported(tmp_path):
    for package in sorted(EVERYTHING - LAUNCHING):
        ran = python(f"import {package}", cwd=tmp_path, without=EVERYTHING - LAUNCHING)
        assert f"ModuleNotFoundError: No module named '{package}'" in ran.stderr


def test_training_needs_torch_and_numpy_only(tmp_path):
    ran = python(TRAIN, cwd=tmp_path, without=EVERYTHING - TRAINING)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert int(ran.stdout) == 27  # every algorithm in every built-in environment that it can act in


def test_a_launch_in_process_needs_four_packages_more(trained):
    _, ran = trained
    assert (ran.returncode, ran.stderr) == (0, "")
    assert f"{TRIALS} of {TRIALS} finished" in ran.stdout


def test_a_store_from_a_bare_machine_is_queried_like_any_other(trained):
    folder, _ = trained
    ran = python(SWEEP, "sql", "SELECT count(*) FROM settings", "--format", "csv", cwd=folder)
    assert (ran.returncode, ran.stdout.split()[-1]) == (0, "8")
    connection = connect(folder / "results")
    counts = "SELECT count(DISTINCT trial), count(*) FROM "
    assert connection.execute(counts + "steps").fetchone() == (TRIALS, TRIALS * 60)
    assert connection.execute(counts + "evaluations").fetchone() == (TRIALS, TRIALS * 2)
    assert connection.execute(counts + "members").fetchone() == (TRIALS, TRIALS)
    connection.close()


def test_shards_that_are_copied_into_another_store_are_read_there(trained, tmp_path):
    folder, _ = trained
    source, target = Store.open(folder / "results"), Store.create(tmp_path / "target")
    shards = sorted((source.path / "shards").iterdir())
    assert len(shards) > 1
    for number, shard in enumerate(shards, start=1):
        shutil.copytree(shard, target.path / "shards" / shard.name)
        connection = connect(target.path)
        assert connection.execute("SELECT count(DISTINCT trial) FROM trials").fetchone()[0] == len(target.finished_trials())
        assert (target.finished_trials() == source.finished_trials()) == (number == len(shards))
        connection.close()
    before, after = connect(source.path), connect(target.path)
    for table in ("trials", "episodes", "steps", "evaluations"):
        query = f"FROM {table} ORDER BY ALL"
        assert before.sql(query).to_arrow_table().to_pylist() == after.sql(query).to_arrow_table().to_pylist() != []
    before.close()
    after.close()
    (tmp_path / "grid.toml").write_text(GRID)
    ran = python(SWEEP, "launch", "grid.toml", "--store", "target", cwd=tmp_path)
    assert ran.stdout == f"tiny: all {TRIALS} trials are finished; nothing to do.\n"


def test_a_launch_without_ray_says_how_to_train_and_writes_nothing(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID)
    for address in ([], ["--address", "127.0.0.1:1"]):
        ran = python(SWEEP, "launch", "grid.toml", *address, cwd=tmp_path, without={"ray"})
        assert (ran.returncode, ran.stdout) == (1, "")
        assert (
            ran.stderr == "error: ray is not installed here: pip install ray, or train in this process: --executor in-process\n"
        )
    assert [file.name for file in tmp_path.iterdir()] == ["grid.toml"]


def test_a_plan_needs_no_more_than_a_launch_and_without_a_pilot_no_ray(trained):
    folder, _ = trained
    for options, without in ((["--executor", "in-process"], EVERYTHING - LAUNCHING), (["--no-pilot"], EVERYTHING - LAUNCHING)):
        ran = python(SWEEP, "plan", "grid.toml", "--store", "other", *options, cwd=folder, without=without)
        assert (ran.returncode, ran.stderr) == (0, "")
        assert f"{TRIALS} trials, 0 finished" in ran.stdout
    ran = python(SWEEP, "plan", "grid.toml", "--store", "other", cwd=folder, without={"ray"})
    assert (ran.returncode, ran.stdout) == (1, "")
    assert ran.stderr == "error: ray is not installed here: pip install ray, or train in this process: --executor in-process\n"
    assert not (folder / "other").exists()


def test_a_doctor_examines_a_machine_where_nothing_but_the_command_line_is_installed(tmp_path):
    ran = python(SWEEP, "doctor", cwd=tmp_path, without=EVERYTHING - {"typer", "pydantic", "rich"})
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.startswith("engine ")
    assert "none that torch can use" in ran.stdout


@pytest.mark.parametrize(
    ("arguments", "missing"),
    [
        (["sql", "FROM trials"], "duckdb"),
        (["analyze", "--figure", "7.1"], "duckdb"),
        (["analyze", "--figure", "7.1"], "pandas"),
        (["analyze", "--figure", "7.1"], "matplotlib"),
        (["analyze", "--figure", "2.1"], "seaborn"),
    ],
)
def test_a_command_that_lacks_a_package_names_it_and_a_way_out(trained, arguments, missing):
    folder, _ = trained
    before = sorted(folder.rglob("*"))
    ran = python(SWEEP, *arguments, cwd=folder, without={missing})
    assert (ran.returncode, ran.stdout) == (1, "")
    way_out = "copy the store, a folder, to a machine that has it"
    assert ran.stderr == f"error: {missing} is not installed here: pip install {missing}, or {way_out}\n"
    assert sorted(folder.rglob("*")) == before


def test_sql_needs_no_plotting_library(trained):
    folder, _ = trained
    ran = python(SWEEP, "sql", "SELECT 1", "--format", "csv", cwd=folder, without={"pandas", "matplotlib", "seaborn", "ray"})
    assert (ran.returncode, ran.stdout.split()[-1]) == (0, "1")


def test_the_command_sql_imports_no_pandas(trained):
    folder, _ = trained
    code = """
import atexit, sys
atexit.register(lambda: print("pandas" in sys.modules))
from sweep.cli import main
main()
"""
    ran = python(code, "sql", "SELECT count(*) AS trials FROM trials", "--format", "csv", cwd=folder)
    assert (ran.returncode, ran.stdout.split()) == (0, ["trials", str(TRIALS), "False"]), ran.stderr


def test_a_process_that_asks_first_and_analyzes_then_has_pandas(trained):
    folder, _ = trained
    code = """
from typer.testing import CliRunner
from sweep.cli import app
assert CliRunner().invoke(app, ["sql", "SELECT 1"]).exit_code == 0
import pandas as pd, pyarrow as pa
print(pa.Table.from_pandas(pd.DataFrame({"a": pd.array([1, None], "Int64")})).column("a").null_count)
"""
    ran = python(code, cwd=folder)
    assert (ran.returncode, ran.stdout) == (0, "1\n"), ran.stderr


def test_an_environment_that_only_gymnasium_could_know_is_a_mistake_in_the_grid_where_gymnasium_is_missing(tmp_path):
    (tmp_path / "grid.toml").write_text(GRID.replace("Pendulum-CA", "Pendulun-CA"))
    ran = python(SWEEP, "launch", "grid.toml", "--executor", "in-process", cwd=tmp_path, without={"gymnasium"})
    assert (ran.returncode, ran.stdout) == (1, "")
    known = "Acrobot-CA, Acrobot-DA, MountainCar-CA, MountainCar-DA, Pendulum-CA, Pendulum-DA"
    reason = f"is not built in ({known} are), and Gymnasium, which may know it, is not installed here"
    assert ran.stderr == f'error: grid.toml: study.environments[1] = "Pendulun-CA": {reason}\n'
    assert [file.name for file in tmp_path.iterdir()] == ["grid.toml"]


def test_a_package_of_the_users_own_code_that_is_missing_is_named_with_the_agent(tmp_path):
    (tmp_path / "mine.py").write_text("import duckdb\n")
    (tmp_path / "grid.toml").write_text(GRID.replace('"SAC"', '"mine:Agent"'))
    ran = python(SWEEP, "launch", "grid.toml", "--executor", "in-process", cwd=tmp_path, without={"duckdb"})
    assert ran.returncode == 1
    assert "cannot be imported: ModuleNotFoundError: No module named 'duckdb'" in ran.stderr
    assert "Traceback" not in ran.stderr
