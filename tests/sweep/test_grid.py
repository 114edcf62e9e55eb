import pytest

from agents.registry import ENVIRONMENTS
from sweep import load
from sweep.grid import builtin_grids, parse
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


GREEDY_AC = (
    "actor_step_size_scale, batch_size, critic_step_size, discrete_critic_input, elite_fraction, elite_reduction, "
    "entropy_gradient, entropy_scale, hidden_layers, num_action_samples, polyak, replay_capacity"
)
BOTH = GREEDY_AC.replace("entropy_scale,", "entropy_scale, entropy_tuning,")
BAD = [
    (
        "steps = 1000",
        "stpes = 1000",
        'study.stpes: unknown key; did you mean "steps"? Known: cutoff, discount, environments, evaluation, name, steps',
    ),
    ("steps = 1000", "", "study.steps: is missing"),
    ("steps = 1000", "steps = 0", "study.steps = 0: must be greater than or equal to 1"),
    ("steps = 1000", 'steps = "many"', "study.steps = 'many': must be a whole number"),
    (
        'name = "study"',
        'name = "../../x"',
        'study.name = "../../x": must be lower-case letters, digits and hyphens, 64 characters at most',
    ),
    ("cutoff = 100", "discount = 1.5", "study.discount = 1.5: must be less than or equal to 1"),
    (
        "cutoff = 100",
        "evaluation = { every = 0, episodes = 1 }",
        "study.evaluation.every = 0: must be greater than or equal to 1",
    ),
    ("cutoff = 100", "discount = nan", "study.discount = nan: must be a finite number"),
    (
        '"MountainCar-CA"]',
        '"MountainCar"]',
        'study.environments[2] = "MountainCar": unknown environment; did you mean "MountainCar-DA"? '
        f"Known: {', '.join(ENVIRONMENTS)}; or a Gymnasium id, such as MountainCar-v0, MountainCarContinuous-v0",
    ),
    (
        '"MountainCar-CA"]',
        '"cartpole-v1"]',
        f'study.environments[2] = "cartpole-v1": unknown environment; Known: {", ".join(ENVIRONMENTS)}; '
        "or a Gymnasium id, such as CartPole-v1, CartPole-v0",
    ),
    (
        '"MountainCar-CA"]',
        '"FrozenLake-v1"]',
        'study.environments[2] = "FrozenLake-v1": observations in Discrete(16) are not supported, only vectors: '
        "Box with one dimension",
    ),
    (
        '"MountainCar-CA"]',
        '"counting_environments:counting/Unbounded-v0"]',
        'study.environments[2] = "counting_environments:counting/Unbounded-v0": actions in Box(-inf, inf, (1,), float32) are '
        "unbounded; a Box of actions must be bounded",
    ),
    ('"MountainCar-CA"]', '"Pendulum-CA"]', 'study.environments[2] = "Pendulum-CA": listed twice'),
    ('["Pendulum-CA", "MountainCar-CA"]', "[]", "study.environments: must not be empty"),
    (
        "tune = 2",
        "tune = 0",
        "seeds.tune = 0: must be a count of seeds (1 to 1,000,000) or a list of seeds (whole numbers from 0, below 2^62)",
    ),
    (
        "tune = 2",
        "tune = [-1]",
        "seeds.tune = [-1]: must be a count of seeds (1 to 1,000,000) or a list of seeds (whole numbers from 0, below 2^62)",
    ),
    ("tune = 2", "tune = [1, 1]", "seeds.tune: seed 1 is listed twice"),
    ("evaluate = 3", "evaluate = [1, 2]", "seeds.evaluate: overlaps with seeds.tune (1): evaluation needs fresh seeds"),
    (
        "batch_size = 16",
        "batch_sise = 16",
        f'fixed.batch_sise: unknown hyperparameter; did you mean "batch_size"? Known: {BOTH}',
    ),
    ("batch_size = 16", "batch_size = [16, 32]", "fixed.batch_size = [16, 32]: must be a whole number"),
    ("[1e-2, 0.001]", "[1e-2, -0.001]", "sweep.critic_step_size: value -0.001 must be greater than 0"),
    ("[1e-2, 0.001]", "[1e-2, inf]", "sweep.critic_step_size: value inf must be finite"),
    ("[1e-2, 0.001]", "[1e-2, 0.01]", "sweep.critic_step_size: value 0.01 is listed twice"),
    ("[1e-2, 0.001]", "[]", "sweep.critic_step_size: nothing to sweep: the list of values is empty"),
    (
        "[1e-2, 0.001]",
        "0.01",
        "sweep.critic_step_size: must be a list, { values = […] }, { logspace = [first exponent, last exponent, count] } or "
        "{ range = [first, last, step] }; a single value belongs in [fixed]",
    ),
    (
        "{ values = [0, 1] }",
        "{ range = [1, 0, 1] }",
        "sweep.entropy_scale: range = [first, last, step] needs a step that leads from first to last in at most 10,000 values",
    ),
    ("batch_size = 16", "critic_step_size = 1", "sweep.critic_step_size: is in fixed too; keep one"),
    (
        'name = "SAC"',
        'name = "sac"',
        'agent[1].name = "sac": unknown agent; did you mean "SAC"? '
        "Known: DDPG, GreedyAC, SAC, SAC-original, VanillaAC; or package.module:Name",
    ),
    (
        "num_action_samples =",
        "num_actions_samples =",
        f'agent[2].sweep.num_actions_samples: unknown hyperparameter; did you mean "num_action_samples"? Known: {GREEDY_AC}',
    ),
    ('"score"', '"scores"', "agent[2].fixed.entropy_gradient = 'scores': must be one of 'sampled', 'analytic', 'score'"),
    (
        '["Pendulum-*"]',
        '["*-DA"]',
        'agent[2].environments[1] = "*-DA": matches none of the study\'s environments: Pendulum-CA, MountainCar-CA',
    ),
    (
        "tune = 2",
        "tune = 100000000000",
        "seeds.tune = 100000000000: must be a count of seeds (1 to 1,000,000) or a list of seeds "
        "(whole numbers from 0, below 2^62)",
    ),
    ('["Pendulum-*"]', "[]", "agent[2].environments: must not be empty"),
    ("[seeds]", "[seed]", 'seed: unknown key; did you mean "seeds"? Known: agent, fixed, seeds, study, sweep'),
]


@pytest.mark.parametrize(("old", "new", "message"), BAD)
def test_each_mistake_is_named_with_its_place_its_value_and_what_would_be_valid(old, new, message):
    with pytest.raises(UserError) as caught:
        parse(edited((old, new)), "grid.toml")
    assert f"grid.toml: {message}" in str(caught.value).splitlines()


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


def test_functions_take_plain_values_and_cannot_be_evaluated():
    with pytest.raises(UserError, match=r"agent\[2\]\.fixed\.a = .*: must be a finite number, a text, true or false, or a list"):
        parse(FUNCTION + "fixed = { a = [[1, 2]] }\n", "grid.toml")
    with pytest.raises(UserError, match=r"study\.evaluation: textwrap:fill cannot be evaluated"):
        parse(FUNCTION.replace("cutoff = 100", "evaluation = { every = 10, episodes = 1 }"), "grid.toml")


def test_all_mistakes_are_named_at_once():
    text = edited(
        ("steps = 1000", "stpes = 1000"), ('"SAC"', '"sac"'), ("[1e-2, 0.001]", "[-1]"), ("evaluate = 3", "evaluate = [1]")
    )
    with pytest.raises(UserError) as caught:
        parse(text, "grid.toml")
    assert len(str(caught.value).splitlines()) == 5  # the misspelled key is missing too


def test_a_grid_without_agents_and_one_that_is_not_toml_are_refused():
    with pytest.raises(UserError, match=r"grid\.toml: agent: is missing"):
        parse(GOOD[: GOOD.index("[[agent]]")], "grid.toml")
    with pytest.raises(UserError, match=r"grid\.toml: not valid TOML: .*line 2"):
        parse("[study]\nname = x\n", "grid.toml")


def test_an_unknown_file_names_the_built_in_studies(tmp_path):
    with pytest.raises(UserError, match='no such grid file, and no built-in study of that name; did you mean "quickstart"'):
        load("quickstrat")


@pytest.mark.parametrize("name", builtin_grids())
def test_every_built_in_study_is_valid_and_named_as_its_file(name):
    assert load(name).name == name
