import pytest

from sweep import load
from sweep.grid import parse
from sweep.messages import UserError
from sweep.trials import expand

GRID = """
[study]
name = "s"
environments = ["Pendulum-CA", "MountainCar-CA"]
steps = 1000
[seeds]
tune = 2
[sweep]
critic_step_size = [0.01, 0.001]
[[agent]]
name = "SAC"
[[agent]]
name = "GreedyAC"
fixed = { batch_size = 16 }
sweep = { num_action_samples = [10, 20] }
"""


@pytest.mark.parametrize(
    ("override", "look", "expected"),
    [
        ("study.steps=500", lambda grid: grid.steps, 500),
        ("study.steps = 1_500", lambda grid: grid.steps, 1500),
        ("study.name=other-name", lambda grid: grid.name, "other-name"),
        ('study.name="other-name"', lambda grid: grid.name, "other-name"),
        ("study.environments=['Acrobot-DA']", lambda grid: grid.environments, ("Acrobot-DA",)),
        ("study.environments[2]=Acrobot-CA", lambda grid: grid.environments, ("Pendulum-CA", "Acrobot-CA")),
        ("study.evaluation={ every = 10, episodes = 2 }", lambda grid: grid.evaluation, (10, 2)),
        ("seeds.tune=[5, 7]", lambda grid: grid.tune_seeds, (5, 7)),
        ("seeds.evaluate=3", lambda grid: grid.evaluate_seeds, (2, 3, 4)),
        ("select.score=step_mean", lambda grid: grid.select.score, "step_mean"),
        ("fixed.polyak=0.5", lambda grid: grid.agents[0].settings[0].polyak, 0.5),
        ("sweep.critic_step_size=[1e-1]", lambda grid: grid.agents[0].values["critic_step_size"], (0.1,)),
        ("agent[1].name=VanillaAC", lambda grid: grid.agents[0].name, "VanillaAC"),
        ("agent[2].fixed.batch_size=64", lambda grid: grid.agents[1].values["batch_size"], (64,)),
        ("agent[2].sweep.num_action_samples[2]=30", lambda grid: grid.agents[1].values["num_action_samples"], (10, 30)),
        ('agent[2].derive.elite_fraction="3 / num_action_samples"', lambda grid: grid.agents[1].settings[0].elite_fraction, 0.3),
        ("environment.Pendulum-CA.steps=7", lambda grid: grid.conditions("Pendulum-CA").steps, 7),
        ('environment."Pendulum-CA".steps=7', lambda grid: grid.conditions("Pendulum-CA").steps, 7),
    ],
)
def test_an_override_changes_the_value_at_its_path_as_if_the_file_had_it(override, look, expected):
    grid = parse(GRID, "grid.toml", [override])
    assert look(grid) == expected
    assert look(parse(GRID, "grid.toml")) != expected
    assert (grid.text, grid.overrides) == (GRID, (override,))


def test_the_trials_are_those_of_a_file_with_the_value():
    overridden = expand(parse(GRID, "a", ["study.steps=500", "agent[2].fixed.batch_size=64"]))
    written = expand(parse(GRID.replace("steps = 1000", "steps = 500").replace("batch_size = 16", "batch_size = 64"), "a"))
    assert [trial.id for trial in overridden] == [trial.id for trial in written]


def test_of_two_overrides_of_one_path_the_later_one_holds():
    assert parse(GRID, "a", ["study.steps=5", "study.steps=7"]).steps == 7


def test_names_of_environments_may_have_dots():
    with pytest.raises(UserError, match=r"environment\.a\.b:C-v0: is none of the study's environments"):
        parse(GRID, "a", ["environment.a.b:C-v0.steps=7"])


def test_a_built_in_study_can_be_overridden():
    assert load("quickstart", ["study.steps=500"]).steps == 500


def test_a_bad_value_is_named_where_the_file_would_have_it():
    with pytest.raises(UserError, match=r"^grid\.toml: agent\[2\]\.fixed\.batch_size = 'many': must be a whole number$"):
        parse(GRID, "grid.toml", ["agent[2].fixed.batch_size=many"])


UNREADABLE = "the value cannot be read: write it as in a grid file, a text in quotes (a bare word needs none)"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("study.steps", "must be path=value, such as study.steps=1000"),
        ("=3", "must be path=value, such as study.steps=1000"),
        ("study.stpes=3", 'study.stpes: unknown key; did you mean "steps"? Known: '
         "cutoff, discount, environments, evaluation, name, steps"),
        ("stduy.steps=3", 'stduy: unknown key; did you mean "study"? Known: '
         "agent, environment, fixed, seeds, select, study, sweep"),
        ("agent[3].name=SAC", "agent has 2 entries, counted from 1"),
        ("agent[0].name=SAC", "agent has 2 entries, counted from 1"),
        ("agent.name=SAC", "agent is a list: say which entry, such as agent[1]"),
        ("agent[1].nmae=SAC", 'agent[1].nmae: unknown key; did you mean "name"? Known: '
         "derive, environments, exclude, fixed, name, sweep, zip"),
        ("study[1].steps=3", "study is no list"),
        ("study.steps.x=3", "study.steps has no keys"),
        ("study..steps=3", '"study..steps" is no path, such as study.steps or agent[1].fixed.batch_size'),
        (".study.steps=3", '".study.steps" is no path, such as study.steps or agent[1].fixed.batch_size'),
        ("environment.Pendulum-CA.step=3", 'environment.Pendulum-CA.step: unknown key; did you mean "steps"? Known: '
         "cutoff, discount, steps"),
        ("study.steps=[1", UNREADABLE),
        ("study.steps=", UNREADABLE),
        ("study.name=two words", UNREADABLE),
        ("study.steps=3\nx = 4", UNREADABLE),
        ("study.steps=" + "[" * 3000, UNREADABLE),
    ],
)  # fmt: skip
def test_a_mistake_in_an_override_is_named_with_the_override(override, message):
    with pytest.raises(UserError) as caught:
        parse(GRID, "grid.toml", [override])
    assert str(caught.value) == f"--set {override}: {message}"


def test_all_mistakes_of_overrides_are_named_at_once():
    with pytest.raises(UserError) as caught:
        parse(GRID, "grid.toml", ["study.stpes=3", "agent[9].name=SAC"])
    assert [line[:20] for line in str(caught.value).splitlines()] == ["--set study.stpes=3:", "--set agent[9].name="]
