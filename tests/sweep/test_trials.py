import hashlib

import pytest

from agents.hypers import GreedyACHypers, SACHypers
from sweep.grid import load, parse
from sweep.messages import UserError
from sweep.trials import Trial, expand

TEXT = """
[study]
name = "s"
environments = ["Pendulum-CA"]
steps = 1000
[seeds]
tune = 2
[sweep]
critic_step_size = [0.01, 0.001]
[[agent]]
name = "SAC"
"""


def trial(**changes):
    hypers = changes.pop("hypers", SACHypers(critic_step_size=0.01))
    known = {"agent": "SAC", "environment": "Pendulum-CA", "seed": 0, "steps": 1000, "cutoff": 1000, "discount": 0.99}
    return Trial(hypers=hypers, **(known | changes))


def test_names_never_change_between_releases():
    """Golden names: a change here orphans every store that exists. It needs a results version, not an edit of this test."""
    hypers = (
        '"hypers":{"actor_step_size_scale":1.0,"batch_size":32,"critic_step_size":0.01,"entropy_scale":0.01,'
        '"hidden_layers":[64,64],"polyak":0.01,"replay_capacity":100000}'
    )
    canonical = (
        '{"agent":"SAC","agent_version":1,"cutoff":1000,"discount":0.99,"environment":"Pendulum-CA","environment_version":1,'
        f'{hypers},"schema":1,"seed":0,"steps":1000}}'
    )
    assert trial().id == hashlib.sha256(canonical.encode()).hexdigest()[:16] == "259d01b6a2d3076f"
    setting = f'{{"agent":"SAC","agent_version":1,{hypers},"schema":1}}'
    assert trial().setting == hashlib.sha256(setting.encode()).hexdigest()[:16]
    assert trial(agent="GreedyAC", hypers=GreedyACHypers(hidden_layers=[64, 64, 64])).id == "8af6fa3b1539ffb0"


def test_everything_that_determines_the_numbers_is_in_the_name():
    variants = [
        trial(),
        trial(seed=1),
        trial(steps=2000),
        trial(cutoff=500),
        trial(discount=1.0),
        trial(environment="MountainCar-CA"),
        trial(hypers=SACHypers(critic_step_size=0.02)),
        trial(hypers=SACHypers(critic_step_size=0.01, hidden_layers=(64, 64, 64))),
        trial(agent="GreedyAC", hypers=GreedyACHypers(critic_step_size=0.01)),
    ]
    assert len({variant.id for variant in variants}) == len(variants)


def test_a_setting_is_the_same_for_all_seeds_and_environments():
    assert len({trial(seed=seed, environment=e).setting for seed in (0, 1) for e in ("Pendulum-CA", "MountainCar-CA")}) == 1


@pytest.mark.parametrize(
    "same",
    [
        TEXT.replace("[0.01, 0.001]", "[1e-3, 1e-2]"),
        TEXT.replace("[0.01, 0.001]", "{ logspace = [-3, -2, 2] }"),
        TEXT.replace("tune = 2", "tune = [1, 0]"),
        TEXT.replace("steps = 1000", "cutoff = 1000\ndiscount = 0.99\nsteps = 1_000"),
        TEXT + "[[agent]]\nname = 'SAC'\nfixed = { critic_step_size = 0.01 }\nsweep = {}\n",
        TEXT.replace("[sweep]", "[fixed]\nbatch_size = 32\n[sweep]"),
    ],
)
def test_another_way_to_write_the_same_study_gives_the_same_trials(same):
    assert {t.id for t in expand(parse(same, "a"))} == {t.id for t in expand(parse(TEXT, "b"))}


def test_adding_a_value_adds_only_the_new_trials():
    before = {t.id for t in expand(parse(TEXT, "a"))}
    after = {t.id for t in expand(parse(TEXT.replace("[0.01,", "[0.1, 0.01,"), "a"))}
    assert before < after
    assert len(after) == 6


def test_equal_settings_become_one():
    text = TEXT + "[[agent]]\nname = 'SAC'\n"
    assert len(expand(parse(text, "a"))) == len({t.id for t in expand(parse(text, "a"))}) == 4


def test_hyperparameters_that_contradict_one_another_are_refused():
    text = TEXT.replace('"SAC"', '"GreedyAC"') + "sweep = { elite_fraction = [0.01, 0.1] }\n"
    with pytest.raises(UserError, match=r"s: GreedyAC: elite_fraction = 0.01: with num_action_samples = 30 no action is elite"):
        expand(parse(text, "a"))


def test_an_enormous_product_is_refused_before_it_is_expanded():
    series = "{ range = [1, 10000, 1] }"
    text = TEXT + f"sweep = {{ entropy_scale = {series}, actor_step_size_scale = {series} }}\n"
    with pytest.raises(UserError, match=r"s: 400,000,000 trials; at most 1,000,000"):
        expand(parse(text, "a"))


def test_the_quickstart_has_two_agents_nine_settings_two_seeds():
    assert len(expand(load("quickstart"))) == 2 * 9 * 2


def test_gymnasium_environments_have_their_own_cutoffs_and_kinds_of_actions():
    names = ["Pendulum-v1", "CartPole-v1", "counting_environments:counting/Box-v0"]
    text = TEXT.replace('["Pendulum-CA"]', str(names)) + '[[agent]]\nname = "DDPG"\n'
    trials = expand(parse(text, "grid.toml"))
    assert {(trial.environment, trial.cutoff) for trial in trials} == set(zip(names, (200, 500, 1000), strict=True))
    assert {trial.environment for trial in trials if trial.agent == "DDPG"} == {names[0], names[2]}
