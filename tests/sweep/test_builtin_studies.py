"""The built-in studies have the sizes of the thesis' experiments, and the small ones end in an hour."""

import tomllib
from collections import Counter
from importlib import resources

import pytest

from sweep.grid import builtin_grids, load
from sweep.messages import UserError
from sweep.trials import candidates, expand, most_evaluation_trials

CONTINUOUS = ["Acrobot-CA", "MountainCar-CA", "Pendulum-CA"]
DISCRETE = ["Acrobot-DA", "MountainCar-DA", "Pendulum-DA"]
QUICK = [name for name in builtin_grids() if "chapter-3" not in name]
PHYSICS = [pytest.param(name, marks=pytest.mark.mujoco) for name in ("thesis/chapter-3", "thesis/small/chapter-3")]
AGENT_STEPS_IN_AN_HOUR = 20e6  # two cores with hidden layers of 64, and time to spare
#: Thesis, tables A.1 to A.4: (κ, critic step-size, τ) for each agent, on each environment and across them.
TUNED = {
    "GreedyAC": {
        "Acrobot-CA": (0.1, 1e-3, 1e-2),
        "Acrobot-DA": (0.1, 1e-2, None),
        "MountainCar-CA": (1.0, 1e-3, 10.0),
        "MountainCar-DA": (2.0, 1e-3, None),
        "Pendulum-CA": (0.1, 1e-2, 10.0),
        "Pendulum-DA": (1.0, 1e-3, None),
        "across": (2.0, 1e-3, 1e-2),
    },
    "VanillaAC": {
        "Acrobot-CA": (2.0, 1e-3, 1e-3),
        "Acrobot-DA": (0.1, 1e-2, 1e-2),
        "MountainCar-CA": (2.0, 1e-3, 1e-3),
        "MountainCar-DA": (1.0, 1e-3, 1e-2),
        "Pendulum-CA": (1e-2, 1e-2, 1e-2),
        "Pendulum-DA": (2.0, 1e-3, 1.0),
        "across": (2.0, 1e-3, 1e-3),
    },
    "SAC": {
        "Acrobot-CA": (10.0, 1e-5, 10.0),
        "Acrobot-DA": (2.0, 1e-5, 10.0),
        "MountainCar-CA": (1.0, 1e-3, 1e-3),
        "MountainCar-DA": (1.0, 1e-3, 1e-2),
        "Pendulum-CA": (0.1, 1e-2, 0.1),
        "Pendulum-DA": (1.0, 1e-3, 1.0),
        "across": (10.0, 1e-5, 10.0),
    },
}


def settings_by_agent_and_environment(trials):
    return Counter((agent, environment) for agent, environment, _ in {(t.agent, t.environment, t.setting) for t in trials})


def ids(name):
    return {trial.id for trial in expand(load(name))}


def test_the_built_in_studies_are_these():
    thesis = ["chapter-3", "chapter-6", "figure-7.1", "figure-7.2"]
    entropy = ["entropy-gradient-sampled", "entropy-gradient-score"]
    published = [
        "published-across-environments",
        "published-entropy-gradient",
        "published-per-environment",
        "published-sample-size",
    ]
    names = [*thesis[:2], *entropy, *thesis[2:], *published, *(f"small/{name}" for name in thesis)]
    assert list(builtin_grids()) == ["quickstart", *(f"thesis/{name}" for name in names)]


@pytest.mark.parametrize("name", builtin_grids())
def test_a_study_is_called_by_its_place_with_hyphens(name):
    parts = name.removeprefix("thesis/").replace("/", "-").replace(".", "-")
    assert tomllib.loads(builtin_grids()[name])["study"]["name"] == parts


@pytest.mark.parametrize("name", [*QUICK, *PHYSICS])
def test_every_built_in_study_is_valid(name):
    assert expand(load(name))


def test_every_file_of_the_grids_is_a_study():
    files = list((resources.files("sweep") / "grids").rglob("*.toml"))
    assert len(files) == len(builtin_grids())


def test_a_study_that_does_not_exist_is_named_with_those_that_do():
    with pytest.raises(UserError) as caught:
        load("thesis/chapter-7")
    assert str(caught.value) == (
        "thesis/chapter-7: no such grid file, and no built-in study of that name; "
        f'did you mean "thesis/chapter-6"? Known: {", ".join(sorted(builtin_grids()))}'
    )


def test_the_quickstarts_trials_have_the_names_that_they_always_had():
    trials = expand(load("quickstart"))
    assert len(trials) == 2 * 9 * 2
    assert [trial.id for trial in trials[:4]] == ["f641513a0b6aa9da", "a6e1b987c5e7fee0", "bbb1035f5920e6c1", "a03956498cad5fa6"]
    assert [trial.id for trial in trials[-2:]] == ["a1c910c745f3dd70", "10d71af8003e5a02"]
    assert trials[18].setting == "ba5800b95fcab1c6"


def test_chapter_6_has_23_400_tuning_trials_and_30_fresh_seeds():
    grid = load("thesis/chapter-6")
    trials = expand(grid)
    assert len(trials) == 23_400
    expected = {(agent, name): 150 for agent in ("GreedyAC", "VanillaAC", "SAC") for name in CONTINUOUS + DISCRETE}
    expected |= {("GreedyAC", name): 30 for name in DISCRETE}
    assert settings_by_agent_and_environment(trials) == expected
    assert sum(expected.values()) == 2_340
    assert sum(trial.steps for trial in trials) == 2_340_000_000
    assert {(trial.cutoff, trial.discount) for trial in trials} == {(1000, 0.99)}
    assert (grid.tune_seeds, grid.evaluate_seeds) == (tuple(range(10)), tuple(range(10, 40)))
    assert grid.select.by == ("per-environment", "across-environments")
    assert len(most_evaluation_trials(grid)) == 2 * 3 * 6 * 30
    assert len(candidates(grid)) == 3 * 150


def test_chapter_6_sweeps_what_the_thesis_sweeps():
    for agent in load("thesis/chapter-6").agents:
        assert set(agent.values["critic_step_size"]) == {1e-1, 1e-2, 1e-3, 1e-4, 1e-5}
        assert set(agent.values["actor_step_size_scale"]) == {1e-3, 1e-2, 1e-1, 1.0, 2.0, 10.0}
        assert set(agent.values["entropy_scale"]) == {1e-3, 1e-2, 1e-1, 1.0, 10.0}
        for hypers in agent.settings:
            assert (hypers.batch_size, hypers.replay_capacity, hypers.polyak) == (32, 100_000, 0.01)
            assert hypers.hidden_layers == (64, 64)


def test_figure_7_1_has_36_000_trials_of_which_9_000_are_chapter_6s():
    grid = load("thesis/figure-7.1")
    trials = expand(grid)
    assert len(trials) == 36_000
    assert settings_by_agent_and_environment(trials) == {(a, e): 150 for a in ("GreedyAC", "SAC") for e in CONTINUOUS}
    assert grid.tune_seeds == tuple(range(40))
    assert len({trial.id for trial in trials} & ids("thesis/chapter-6")) == 9_000


def test_figure_7_2_has_9_000_trials_of_which_3_000_are_chapter_6s():
    grid = load("thesis/figure-7.2")
    trials = expand(grid)
    assert len(trials) == 9_000
    assert settings_by_agent_and_environment(trials) == {("GreedyAC", environment): 300 for environment in CONTINUOUS}
    assert {(trial.hypers.num_action_samples, trial.hypers.num_elites) for trial in trials} == {(10, 3), (20, 3), (30, 3)}
    assert {trial.hypers.critic_step_size for trial in trials} == {1e-1, 1e-2, 1e-3, 1e-4}
    assert {trial.hypers.actor_step_size_scale for trial in trials} == {1e-3, 1e-2, 1e-1, 1.0, 2.0}
    assert grid.select.for_each == ("num_action_samples",)
    assert len(most_evaluation_trials(grid)) == 3 * 3 * 10
    assert len({trial.id for trial in trials} & ids("thesis/chapter-6")) == 3_000


@pytest.mark.parametrize("name", [name for name in QUICK if "small" in name])
def test_the_small_studies_end_within_an_hour_on_two_cores(name):
    grid = load(name)
    trials = expand(grid) + most_evaluation_trials(grid)
    assert sum(trial.steps for trial in trials) <= AGENT_STEPS_IN_AN_HOUR
    assert {trial.hypers.hidden_layers for trial in trials} == {(64, 64)}


def test_small_chapter_6_has_every_setting_that_the_thesis_found_best():
    tried = {}
    for trial in expand(load("thesis/small/chapter-6")):
        values = trial.applicable_hypers
        setting = values["actor_step_size_scale"], values["critic_step_size"], values.get("entropy_scale")
        tried.setdefault((trial.agent, trial.environment), set()).add(setting)
    across = {
        (
            candidate.agent,
            candidate.hypers.actor_step_size_scale,
            candidate.hypers.critic_step_size,
            candidate.hypers.entropy_scale,
        )
        for candidate in candidates(load("thesis/small/chapter-6"))
    }
    for agent, tuned in TUNED.items():
        assert (agent, *tuned["across"]) in across
        for environment in CONTINUOUS + DISCRETE:
            assert tuned[environment] in tried[agent, environment], (agent, environment)


def test_small_figure_7_1_has_all_five_entropy_scales_and_step_sizes():
    trials = expand(load("thesis/small/figure-7.1"))
    drawn = {(t.agent, t.environment, t.hypers.entropy_scale, t.hypers.critic_step_size) for t in trials}
    assert len(drawn) == 2 * 3 * 5 * 5


def test_small_figure_7_2_has_the_settings_found_best_for_each_number_of_samples():
    tried = {
        (
            t.environment,
            t.hypers.num_action_samples,
            t.hypers.actor_step_size_scale,
            t.hypers.critic_step_size,
            t.hypers.entropy_scale,
        )
        for t in expand(load("thesis/small/figure-7.2"))
    }
    assert {(name, N, *TUNED["GreedyAC"][name]) for name in CONTINUOUS for N in (10, 20, 30)} <= tried


@pytest.mark.mujoco
def test_chapter_3_has_30_runs_of_3_million_steps_of_three_agents():
    trials = expand(load("thesis/chapter-3"))
    assert len(trials) == 3 * 30
    assert {(trial.environment, trial.steps, trial.evaluation) for trial in trials} == {("HalfCheetah-v5", 3_000_000, (1_000, 1))}
    ddpgs = {trial.hypers for trial in trials if trial.agent == "DDPG"}
    assert {hypers.exploration_noise for hypers in ddpgs} == {"gaussian", "ornstein-uhlenbeck"}
    assert {trial.hypers.hidden_layers for trial in trials} == {(256, 256)}


@pytest.mark.mujoco
def test_small_chapter_3_ends_within_an_hour_on_two_cores():
    trials = expand(load("thesis/small/chapter-3"))
    learning = sum(trial.steps for trial in trials)
    evaluating = sum(trial.steps // trial.evaluation[0] * trial.cutoff for trial in trials)
    assert {trial.agent for trial in trials} == {"SAC-original", "DDPG"}
    assert learning + evaluating <= 600 * 3_600


@pytest.mark.parametrize(("name", "by"), [("per-environment", None), ("across-environments", "across")])
def test_the_published_studies_have_the_printed_settings_and_thirty_seeds(name, by):
    trials = expand(load(f"thesis/published-{name}"))
    assert len(trials) == 540
    for agent, printed in TUNED.items():
        for environment in CONTINUOUS + DISCRETE:
            scale, step_size, entropy_scale = printed[by or environment]
            of_both = [t for t in trials if (t.agent, t.environment) == (agent, environment)]
            assert sorted(t.seed for t in of_both) == list(range(10, 40))
            assert {t.steps for t in of_both} == {100_000}
            (hypers,) = {t.setting: t.applicable_hypers for t in of_both}.values()
            assert (hypers["actor_step_size_scale"], hypers["critic_step_size"]) == (scale, step_size)
            if (agent, environment[-2:]) != ("GreedyAC", "DA"):
                assert hypers["entropy_scale"] == entropy_scale


def test_the_sample_sizes_share_the_trials_of_thirty_samples_with_the_published_settings():
    trials = expand(load("thesis/published-sample-size"))
    samples = [(t.environment, t.applicable_hypers["num_action_samples"], t.setting) for t in trials]
    assert [known[:2] for known in samples] == [(environment, n) for environment in CONTINUOUS for n in (10, 20, 30)]
    printed = {t.setting for t in expand(load("thesis/published-per-environment")) if t.agent == "GreedyAC"}
    assert [known[1] for known in samples if known[2] in printed] == [30, 30, 30]


def test_the_entropy_gradient_studies_differ_in_the_gradient_alone():
    sampled, score = (expand(load(f"thesis/entropy-gradient-{name}")) for name in ("sampled", "score"))
    assert {t.id for t in sampled if t.agent == "SAC"} == {t.id for t in score if t.agent == "SAC"}
    for trials, name in ((sampled, "sampled"), (score, "score")):
        greedy = [t for t in trials if t.agent == "GreedyAC"]
        assert {t.applicable_hypers["entropy_gradient"] for t in greedy} == {name}
        assert (len(greedy), len({t.setting for t in greedy}), len(trials)) == (300, 150, 600)


def test_the_published_settings_are_tried_with_each_entropy_gradient():
    trials = expand(load("thesis/published-entropy-gradient"))
    gradients = Counter((t.agent, t.applicable_hypers["entropy_gradient"]) for t in trials)
    assert gradients == {(agent, name): 30 for agent in ("GreedyAC", "VanillaAC") for name in ("sampled", "analytic", "score")}
    assert len({t.id for t in trials} & ids("thesis/published-per-environment")) == 60
