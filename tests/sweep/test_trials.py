import dataclasses
import hashlib
import json
import time
import tracemalloc

import pytest

from agents.hypers import FreeHypers, GreedyACHypers, SACHypers
from sweep.grid import parse
from sweep.messages import UserError
from sweep.trials import Trial, candidates, evaluation_trials, expand, most_evaluation_trials, trial_of

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
    with pytest.raises(UserError, match=r"a: agent\[1\]: elite_fraction = 0.01: with num_action_samples = 30 no action is elite"):
        parse(text, "a")


def test_an_enormous_product_is_refused_before_it_is_expanded():
    series = "{ range = [1, 10000, 1] }"
    text = TEXT + f"sweep = {{ entropy_scale = {series}, actor_step_size_scale = {series} }}\n"
    with pytest.raises(UserError, match=r"a: 400,000,000 trials; at most 1,000,000"):
        parse(text, "a")


def test_a_group_that_varies_together_counts_once():
    series = "{ range = [1, 10000, 1] }"
    text = TEXT.replace("tune = 2", "tune = 50") + f"sweep = {{ entropy_scale = {series}, actor_step_size_scale = {series} }}\n"
    assert len(parse(text + 'zip = [["entropy_scale", "actor_step_size_scale"]]\n', "a").agents[0].settings) == 20_000


def test_gymnasium_environments_have_their_own_cutoffs_and_kinds_of_actions():
    names = ["Pendulum-v1", "CartPole-v1", "counting_environments:counting/Box-v0"]
    text = TEXT.replace('["Pendulum-CA"]', str(names)) + '[[agent]]\nname = "DDPG"\n'
    trials = expand(parse(text, "grid.toml"))
    assert {(trial.environment, trial.cutoff) for trial in trials} == set(zip(names, (200, 500, 1000), strict=True))
    assert {trial.environment for trial in trials if trial.agent == "DDPG"} == {names[0], names[2]}


def test_an_environments_own_steps_cutoff_and_discount_are_those_of_its_trials():
    text = TEXT.replace('"Pendulum-CA"', '"Pendulum-CA", "Acrobot-CA"')
    text += "[environment.Acrobot-CA]\nsteps = 50\ncutoff = 20\ndiscount = 1.0\n"
    found = {(trial.environment, trial.steps, trial.cutoff, trial.discount) for trial in expand(parse(text, "a"))}
    assert found == {("Pendulum-CA", 1000, 1000, 0.99), ("Acrobot-CA", 50, 20, 1.0)}


def test_names_that_are_worked_out_for_all_seeds_at_once_are_those_of_the_trials_alone():
    text = TEXT.replace('["Pendulum-CA"]', '["Pendulum-CA", "Acrobot-DA"]\nevaluation = { every = 10, episodes = 1 }')
    for made in expand(parse(text + '[[agent]]\nname = "GreedyAC"\n', "a")):
        alone = dataclasses.replace(made)
        assert not {"id", "setting", "applicable_hypers"} & vars(alone).keys()
        assert (made.id, made.setting, made.applicable_hypers) == (alone.id, alone.setting, alone.applicable_hypers)


def test_a_hyperparameter_named_like_a_part_of_the_name_does_not_confuse_it():
    hypers = FreeHypers(zeed='"seed":0,"steps"')
    assert trial(agent="textwrap:fill", hypers=hypers, seed=1).id != trial(agent="textwrap:fill", hypers=hypers, seed=2).id
    identity = {
        "schema": 1, "agent": "textwrap:fill", "agent_version": 1, "hypers": {"zeed": '"seed":0,"steps"'}, "seed": 1,
        "environment": "Pendulum-CA", "environment_version": 1, "steps": 1000, "cutoff": 1000, "discount": 0.99,
    }  # fmt: skip
    canonical = json.dumps(identity, sort_keys=True, separators=(",", ":"))
    expected = hashlib.sha256(canonical.encode()).hexdigest()[:16]
    assert trial(agent="textwrap:fill", hypers=hypers, seed=1).id == expected


def test_a_great_study_is_expanded_quickly():
    text = TEXT.replace("tune = 2", "tune = 100").replace("[0.01, 0.001]", "{ range = [1, 24, 1] }")
    grid = parse(text + "sweep = { entropy_scale = { range = [1, 24, 1] } }\n", "a")
    tracemalloc.start()
    try:
        trials = expand(grid)
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len({made.id for made in trials}) == 576 * 100
    assert kept < 60e6
    start = time.process_time()
    assert len({made.id for made in expand(grid)}) == 576 * 100
    assert time.process_time() - start < 5  # 0.5 s where it was measured


MIXED = """
[study]
name = "s"
environments = ["Pendulum-CA", "Pendulum-DA"]
steps = 1000
[seeds]
tune = 2
evaluate = 3
[[agent]]
name = "GreedyAC"
sweep = { entropy_scale = [0.1, 1.0, 10.0], critic_step_size = [0.1, 0.01] }
"""


def test_candidates_are_the_settings_before_anything_is_dropped():
    found = candidates(parse(MIXED, "a"))
    assert {(c.hypers.entropy_scale, c.hypers.critic_step_size) for c in found} == {
        (scale, step_size) for scale in (0.1, 1.0, 10.0) for step_size in (0.1, 0.01)
    }
    assert {(c.agent, c.environments) for c in found} == {("GreedyAC", ("Pendulum-CA", "Pendulum-DA"))}
    assert len(found) == 6


def test_candidates_that_are_equal_on_all_their_environments_are_one():
    found = candidates(parse(MIXED.replace('"Pendulum-CA", "Pendulum-DA"', '"Pendulum-DA"'), "a"))
    assert [candidate.hypers.critic_step_size for candidate in found] == [0.1, 0.01]


def test_two_sections_of_one_agent_give_candidates_of_one_agent():
    more = '[[agent]]\nname = "GreedyAC"\nfixed = { entropy_scale = 1.0 }\nsweep = { critic_step_size = [0.1, 0.5] }\n'
    found = candidates(parse(MIXED + more, "a"))
    assert len(found) == 7
    assert {candidate.agent for candidate in found} == {"GreedyAC"}


def test_a_trial_of_a_study_is_one_that_it_expands_to():
    grid = parse(MIXED.replace("steps = 1000", "steps = 1000\nevaluation = { every = 10, episodes = 1 }"), "a")
    made = {trial.id for trial in expand(grid)}
    for candidate in candidates(grid):
        for environment in candidate.environments:
            assert {trial_of(grid, candidate.agent, environment, candidate.hypers, seed).id for seed in (0, 1)} <= made


def test_what_was_chosen_is_evaluated_once_on_each_evaluation_seed():
    grid = parse(MIXED, "a")
    first, second, *_ = (candidate.hypers for candidate in candidates(grid))
    chosen = [("GreedyAC", "Pendulum-CA", first), ("GreedyAC", "Pendulum-CA", first), ("GreedyAC", "Pendulum-DA", second)]
    found = [(trial.environment, trial.hypers, trial.seed) for trial in evaluation_trials(grid, chosen)]
    assert found == [
        *(("Pendulum-CA", first, seed) for seed in (2, 3, 4)),
        *(("Pendulum-DA", second, seed) for seed in (2, 3, 4)),
    ]


@pytest.mark.parametrize(
    ("select", "choices"),
    [
        ("", 2 + 2),
        ('[select]\nby = ["per-environment"]\n', 1 + 1),
        ('[select]\nfor_each = ["entropy_scale"]\n', 6 + 2),  # of 3 × 2 settings with continuous actions, 2 with discrete ones
        ('[select]\nby = ["per-environment"]\nfor_each = ["entropy_scale"]\n', 3 + 2),
        ('[select]\nfor_each = ["entropy_scale", "critic_step_size"]\n', 6 + 2),
    ],
)
def test_there_are_as_many_stand_ins_for_evaluation_as_there_can_be_choices(select, choices):
    found = most_evaluation_trials(parse(MIXED + select, "a"))
    assert len(found) == len({trial.id for trial in found}) == choices * 3
    assert {trial.seed for trial in found} == {2, 3, 4}


def test_nothing_is_evaluated_without_evaluation_seeds():
    assert most_evaluation_trials(parse(MIXED.replace("evaluate = 3\n", ""), "a")) == []
