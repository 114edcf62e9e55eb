"""The tutorial, done as it says: its files written, its commands run in turn."""

import re
import shlex
from pathlib import Path

from typer.testing import CliRunner

from sweep.cli import app

PAGE = (Path(__file__).parent.parent / "docs" / "tutorial.md").read_text(encoding="utf-8")
STEPS = re.findall(r"```(python|toml|console)\n(.*?)```", PAGE, re.DOTALL)


def run(command, runner):
    words = shlex.split(command)
    assert words[0] == "sweep"
    ran = runner.invoke(app, words[1:])
    assert ran.exit_code == 0, f"{command}\n{ran.output}\n{ran.exception}"
    return ran.output


def test_every_file_and_command_of_the_tutorial_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delenv("SWEEP_STORE", raising=False)
    runner, printed = CliRunner(), {}
    for kind, text in STEPS:
        if kind == "console":
            for command in re.findall(r"^\$ (.*)$", text, re.MULTILINE):
                printed.setdefault(command, []).append(run(command, runner))
            continue
        heading, _, content = text.partition("\n")
        name = heading.removeprefix("# ").removeprefix("addition to ")
        with (tmp_path / name).open("a", encoding="utf-8") as file:
            file.write(content)
    first, second = printed["sweep launch corridor.toml --executor in-process"]
    # 2 settings of GreedyAC and 4 of SAC on 3 seeds, the best of each on 5; then 2 of Q-learning on 3, the best one on 5
    assert re.findall(r"(\d+) trials trained .* (\d+) of (\d+) finished", first) == [("18", "18", "18"), ("10", "10", "10")]
    assert re.findall(r"(\d+) trials trained .* (\d+) of (\d+) finished", second) == [("6", "24", "24"), ("5", "15", "15")]
    assert sorted(path.name for path in (tmp_path / "figures").glob("*.png")) == [
        "figure-learning-curve.png",
        "figure-seed-spread.png",
    ]
    assert (tmp_path / "figure-6.1.png").exists() and (tmp_path / "report.html").exists()
    assert not list((tmp_path / "to-publish").rglob("steps.parquet"))
    last = printed[next(command for command in printed if "avg(episode_mean)" in command)][0]
    rows = dict(re.findall(r"^(\S+)\s+(\d+)\s", last, re.MULTILINE))
    assert rows == {"GreedyAC": "11", "SAC": "17", "my_agent:q_learning": "11"}
