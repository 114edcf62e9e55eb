import dataclasses
import re
import tomllib
from pathlib import Path

import pytest

from agents.registry import find_algorithm
from sweep import grid_checks, load
from sweep.grid import Conditions, Select, builtin_grids, parse
from sweep.messages import UserError
from sweep.trials import expand

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
sweep = { entropy_scale = [10], num_action_samples = { range = [10, 30, 10] }, hidden_layers = [[64, 64], [64, 64, 64]] }
fixed = { critic_step_size = 0.1, entropy_gradient = "score" }
"""


def edited(*replacements):
    text = GOOD
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    return text


def test_a_good_grid_is_resolved_with_the_agents_own_values_before_the_studys():
    grid = parse(GOOD, "grid.toml")
    assert (grid.name, grid.steps, grid.cutoff, grid.discount) == ("study", 1000, 100, 0.99)
    assert (grid.tune_seeds, grid.evaluate_seeds) == ((0, 1), (2, 3, 4))
    sac, greedy = grid.agents
    assert sac.environments == ("Pendulum-CA", "MountainCar-CA")
    assert sac.values == {"batch_size": (16,), "critic_step_size": (0.01, 0.001), "entropy_scale": (0.0, 1.0)}
    assert greedy.environments == ("Pendulum-CA",)
    assert greedy.values == {
        "batch_size": (16,),
        "critic_step_size": (0.1,),
        "entropy_scale": (10.0,),
        "num_action_samples": (10, 20, 30),
        "hidden_layers": ((64, 64), (64, 64, 64)),
        "entropy_gradient": ("score",),
    }


def test_logspace_gives_the_powers_that_one_would_type():
    grid = parse(edited(("[1e-2, 0.001]", "{ logspace = [-5, -1, 5] }")), "grid.toml")
    assert grid.agents[0].values["critic_step_size"] == (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)


def test_an_agent_that_cannot_act_in_a_gymnasium_environment_is_named():
    text = edited(('["Pendulum-CA", "MountainCar-CA"]', '["CartPole-v1"]'), ('name = "SAC"', 'name = "DDPG"'))
    with pytest.raises(UserError, match=r"agent\[1\]\.environments: DDPG acts in continuous action spaces only"):
        parse(text, "grid.toml")


def test_evaluation_that_could_not_happen_is_refused():
    with pytest.raises(UserError, match=r"every = 2000: trials end after 1,000 steps; no evaluation would happen"):
        parse(edited(("cutoff = 100", "evaluation = { every = 2_000, episodes = 1 }")), "grid.toml")


FUNCTION = GOOD[: GOOD.index("[sweep]")] + '[[agent]]\nname = "SAC"\n[[agent]]\nname = "textwrap:fill"\n'


def test_a_function_does_not_make_a_misspelled_name_right_for_the_others():
    parse(FUNCTION, "grid.toml")
    with pytest.raises(UserError, match=r'fixed\.batch_sise: unknown hyperparameter; did you mean "batch_size"'):
        parse(FUNCTION.replace("batch_size", "batch_sise"), "grid.toml")


@pytest.mark.parametrize("name", ["seed", "agent", "steps", "episode_mean"])
def test_a_hyperparameter_may_not_take_the_name_of_a_column(name):
    with pytest.raises(UserError, match=rf"agent\[2\]\.sweep\.{name}: is the name of a column of every trial"):
        parse(FUNCTION + f"sweep = {{ {name} = [1, 2] }}\n", "grid.toml")


@pytest.mark.parametrize("name", ["mean", "Score", "num_settings", "standard_error", "is_frozen", "step_mean_low", "num_planned"])
def test_nor_that_of_a_column_of_the_tables_of_results(name):
    with pytest.raises(UserError, match=rf"agent\[2\]\.sweep\.{name}: is the name of a column of the tables of results; a hyper"):
        parse(FUNCTION + f"sweep = {{ {name} = [1, 2] }}\n", "grid.toml")
    with pytest.raises(UserError, match=rf"agent\[2\]\.derive\.{name}: is the name of a column of the tables of results"):
        parse(FUNCTION + f'sweep = {{ x = [1, 2] }}\nderive = {{ {name} = "x" }}\n', "grid.toml")


def test_names_of_columns_are_refused_in_upper_case_as_well():
    with pytest.raises(UserError, match=r"agent\[2\]\.fixed\.SEED: is the name of a column of every trial"):
        parse(FUNCTION + "fixed = { SEED = 1 }\n", "grid.toml")


def test_hyperparameters_that_differ_in_case_alone_are_refused():
    with pytest.raises(UserError, match=r'agent\[2\]\.sweep\.Width: differs from "width" in case alone'):
        parse(FUNCTION + "fixed = { width = 1 }\nsweep = { Width = [1, 2] }\n", "grid.toml")
    with pytest.raises(UserError, match=r'agent\[2\]\.fixed\.Polyak: differs from "polyak" in case alone'):
        parse(FUNCTION + "fixed = { Polyak = 0.5 }\n", "grid.toml")  # a hyperparameter of GreedyAC's: a column of every store
    parse(FUNCTION + "fixed = { polyak = 0.5, width = 1 }\n", "grid.toml")


def test_a_declared_hyperparameter_may_not_take_the_name_of_a_column_either(monkeypatch):
    known = find_algorithm("SAC")
    hypers = type("Odd", (known.hypers,), {})
    hypers.table = {**known.hypers.table, "Mean": known.hypers.table["polyak"]}
    odd = dataclasses.replace(known, name="Odd", hypers=hypers)
    monkeypatch.setattr(grid_checks, "find_algorithm", lambda name: odd if name == "Odd" else find_algorithm(name))
    raw = tomllib.loads(FUNCTION.replace('"SAC"', '"Odd"'))
    (problem,) = grid_checks.problems(raw)
    assert problem.startswith('agent[1].name = "Odd": its hyperparameter "Mean" is the name of a column of the tables of results')


def test_functions_take_plain_values_and_cannot_be_evaluated():
    with pytest.raises(UserError, match=r"agent\[2\]\.fixed\.a = .*: must be a finite number, a text, true or false, or a list"):
        parse(FUNCTION + "fixed = { a = [[1, 2]] }\n", "grid.toml")
    with pytest.raises(UserError, match=r"study\.evaluation: textwrap:fill cannot be evaluated"):
        parse(FUNCTION.replace("cutoff = 100", "evaluation = { every = 10, episodes = 1 }"), "grid.toml")


def test_a_grid_without_agents_and_one_that_is_not_toml_are_refused():
    with pytest.raises(UserError, match=r"grid\.toml: agent: is missing"):
        parse(GOOD[: GOOD.index("[[agent]]")], "grid.toml")
    with pytest.raises(UserError, match=r"grid\.toml: not valid TOML: .*line 2"):
        parse("[study]\nname = x\n", "grid.toml")


def test_an_unknown_file_names_the_built_in_studies(tmp_path):
    with pytest.raises(UserError, match='no such grid file, and no built-in study of that name; did you mean "quickstart"'):
        load("quickstrat")


def test_an_environment_may_have_its_own_steps_cutoff_and_discount():
    grid = parse(GOOD + '[environment."Pendulum-CA"]\nsteps = 500\ndiscount = 0.0\n', "grid.toml")
    assert grid.conditions("Pendulum-CA") == Conditions(steps=500, cutoff=100, discount=0.0)
    assert grid.conditions("MountainCar-CA") == Conditions(steps=1000, cutoff=100, discount=0.99)
    assert parse(GOOD + "[environment.Pendulum-CA]\ncutoff = 7\n", "a").conditions("Pendulum-CA").cutoff == 7
    without = parse(edited(("cutoff = 100\n", "")) + "[environment.Pendulum-CA]\ncutoff = 7\n", "grid.toml")
    assert without.conditions("Pendulum-CA").cutoff == 7
    assert without.conditions("MountainCar-CA").cutoff == 1_000  # its own


def test_what_is_selected_has_defaults_and_can_be_changed():
    assert parse(GOOD, "a").select == Select(("per-environment", "across-environments"), "episode_mean", "thesis", "worst", ())
    text = GOOD + (
        '[select]\nby = ["across-environments"]\nscore = "final_mean"\nnormalizer = "cdf"\ndiverged = "drop"\n'
        'for_each = ["num_action_samples"]\n'
    )
    assert parse(text, "a").select == Select(("across-environments",), "final_mean", "cdf", "drop", ("num_action_samples",))


def test_selecting_needs_no_evaluation_seeds():
    assert parse(edited(("evaluate = 3\n", "")) + '[select]\nscore = "step_mean"\n', "a").evaluate_seeds == ()


def test_a_local_file_comes_before_a_built_in_study(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load("quickstart").name == "quickstart"
    (tmp_path / "quickstart").write_text(GOOD)
    assert load("quickstart").name == "study"


EXAMPLES = re.findall(r"```toml\n(.*?)```", (Path(__file__).parents[2] / "docs" / "grid.md").read_text("utf-8"), re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES)
def test_the_examples_of_the_documentation_are_valid(example):
    """A part of a grid goes with the beginning of the first example, and an agent where it has none."""
    if "[study]" not in example:
        agent = "" if "[[agent]]" in example else '[[agent]]\nname = "SAC"\n'
        example = EXAMPLES[0][: EXAMPLES[0].index("[fixed]")] + agent + example
    assert expand(parse(example, "docs/grid.md"))


def test_the_documentation_gives_the_sizes_of_the_built_in_studies():
    text = (Path(__file__).parents[2] / "docs" / "grid.md").read_text("utf-8")
    rows = dict(re.findall(r"^\| `([^`]+)` \| [^|]+ \| ([0-9,]+) of ", text, re.MULTILINE))
    assert sorted(rows) == sorted(builtin_grids())
    for name in rows:
        if "chapter-3" not in name:  # needs MuJoCo
            assert len(expand(load(name))) == int(rows[name].replace(",", "")), name
