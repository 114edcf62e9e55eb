"""Malformed grids, each with all that is said of it: `malformed_grids.txt` has what is changed (-, +) and the messages (>)."""

import time
from pathlib import Path

import pytest

from sweep.grid import parse
from sweep.messages import UserError

GOOD = """
[study]
name = "study"
environments = ["Pendulum-CA", "MountainCar-CA"]
steps = 1000
cutoff = 100

[seeds]
tune = 2
evaluate = 3

[fixed]
batch_size = 16

[sweep]
critic_step_size = [1e-2, 0.001]
entropy_scale = { values = [0, 1] }

[[agent]]
name = "SAC"

[[agent]]
name = "GreedyAC"
environments = ["Pendulum-*"]
sweep = { actor_step_size_scale = [0.1, 1.0], num_action_samples = [10, 20] }
"""
CASES = Path(__file__).with_name("malformed_grids.txt").read_text("utf-8").strip().split("\n\n")


def read(case):
    """The text of the malformed grid, and the messages. Lines (+) that replace none (-) go to the end: to the last agent."""
    text, old, new, messages = GOOD, [], [], []
    for line in [*case.splitlines()[1:], ">"]:
        if (line[0] != "+" and new) or (line[0] == ">" and old):
            assert "\n".join(old) in text
            text = text.replace("\n".join(old), "\n".join(new)) if old else text + "\n".join(new)
            old, new = [], []
        {"-": old, "+": new, ">": messages}[line[0]].append(line[2:])
    return text, messages[:-1]


@pytest.mark.parametrize("case", CASES, ids=[case.splitlines()[0] for case in CASES])
def test_each_mistake_is_named_with_its_place_its_value_and_what_would_be_valid(case):
    text, messages = read(case)
    start = time.perf_counter()
    with pytest.raises(UserError) as caught:
        parse(text, "grid.toml")
    assert str(caught.value).splitlines() == [f"grid.toml: {message}" for message in messages]
    assert time.perf_counter() - start < 10  # towers of powers and enormous products are refused, not worked out


def test_the_grid_without_a_mistake_is_read():
    assert len(CASES) > 100
    assert parse(GOOD, "grid.toml").name == "study"


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ("[" * 3000 + "]" * 3000, "not valid TOML: nested too deeply"),
        ("1" * 5000, "not valid TOML: a number of thousands of digits"),
        ("0x" + "F" * 5000, "study.steps = a number of thousands of digits: must be less than or equal to 2147483647"),
        ('"' + "x" * 5000 + '"', f"study.steps = '{'x' * 79}…: must be a whole number"),
    ],
)
def test_what_is_enormous_is_not_repeated(steps, message):
    with pytest.raises(UserError) as caught:
        parse(GOOD.replace("steps = 1000", f"steps = {steps}"), "grid.toml")
    assert str(caught.value) == f"grid.toml: {message}"


def test_all_mistakes_are_named_at_once():
    edits = [("steps = 1000", "stpes = 1000"), ('"SAC"', '"sac"'), ("[1e-2, 0.001]", "[-1]"), ("evaluate = 3", "evaluate = [1]")]
    text = GOOD
    for old, new in edits:
        text = text.replace(old, new)
    with pytest.raises(UserError) as caught:
        parse(text + 'derive = { elite_fraction = "3 //" }\n[select]\nscore = "mean"\n', "grid.toml")
    places = [line.split(": ")[1].split(" =")[0] for line in str(caught.value).splitlines()]
    assert set(places) == {
        "study.steps",
        "study.stpes",
        "agent[1].name",
        "sweep.critic_step_size",
        "seeds.evaluate",
        "agent[2].derive.elite_fraction",
        "select.score",
    }
