"""The examples of docs/extending.md, run as they stand there."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture
def folder(tmp_path):
    """A folder with the document's files."""
    text = (ROOT / "docs" / "extending.md").read_text()
    for name, content in re.findall(r"```\w+\n# ([\w.]+)\n(.*?)```", text, re.DOTALL):
        (tmp_path / name).write_text(content)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["grid.toml", "my_agents.py", "my_code.py"]
    return tmp_path


def sweep(*arguments, cwd):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", "from sweep.cli import main; main()", *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


def rows(query, cwd):
    return json.loads(sweep("sql", query, "--format", "json", cwd=cwd).stdout)


@pytest.mark.parametrize("executor", ["in-process", "ray"])
def test_an_algorithm_of_ones_own_is_trained_as_a_population(folder, executor):
    grid = folder / "grid.toml"
    grid.write_text(grid.read_text().replace("10_000", "300"))
    ran = sweep("launch", "grid.toml", "--executor", executor, cwd=folder)
    assert ran.returncode == 0, ran.stderr + ran.stdout
    found = rows("SELECT agent, exploration, critic_step_size, population, episode_mean FROM trials ORDER BY ALL", folder)
    assert [row["agent"] for row in found] == ["my_agents:DQN"] * 8
    assert {row["exploration"] for row in found} == {0.05, 0.1}
    assert {row["population"] for row in found} == {8 if executor == "in-process" else 4}
    assert len({row["episode_mean"] for row in found}) > 4


@pytest.mark.parametrize("executor", ["in-process", "ray"])
def test_a_function_that_was_not_written_for_populations_is_swept(folder, executor):
    grid = folder / "grid.toml"
    text = grid.read_text().replace("10_000", "100")
    grid.write_text(
        text[: text.index("[[agent]]")] + '[[agent]]\nname = "my_code:random_search"\nsweep = { reward_scale = [1.0, 0.5] }\n'
    )
    ran = sweep("launch", "grid.toml", "--executor", executor, cwd=folder)
    assert ran.returncode == 0, ran.stderr + ran.stdout
    found = rows("SELECT seed, reward_scale, best_episode, steps, population FROM trials ORDER BY seed, reward_scale", folder)
    assert [row["best_episode"] for row in found[::2]] == [row["best_episode"] / 2 for row in found[1::2]]
    assert {row["population"] for row in found} == {1}
    assert rows("SELECT count(*) AS n FROM steps", folder) == [{"n": 400}]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("my_agents:DQM", 'agent[1].name = "my_agents:DQM": the module my_agents has no DQM'),
        ("nowhere:DQN", "agent[1].name = \"nowhere:DQN\": cannot be imported: ModuleNotFoundError: No module named 'nowhere'"),
        ("dataclasses:Field", "declares no hyperparameters: `hypers` must be a subclass of ActorCriticHypers"),
        ("broken:DQN", "cannot be imported: SyntaxError"),
        ("sys:path", "is neither a class nor a function"),
    ],
)
def test_a_name_that_leads_nowhere_is_refused_before_anything_is_written(folder, name, message):
    grid = folder / "grid.toml"
    (folder / "broken.py").write_text("class")
    grid.write_text(grid.read_text().replace("my_agents:DQN", name))
    ran = sweep("launch", "grid.toml", cwd=folder)
    assert ran.returncode == 1
    assert message in ran.stderr
    assert not (folder / "results").exists()
