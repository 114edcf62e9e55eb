"""Which settings may be chosen: runs that diverged, have no score or are missing; ties, and each value asked for."""

import pytest
from selection_studies import GREEDY, SAC, grid, score

from sweep.messages import UserError
from sweep.selection import IncompleteError, TrialScores, select
from sweep.trials import expand


def test_a_diverged_run_scores_the_worst_return_or_is_left_out():
    runs = {0.1: [-100, "diverged"], 0.01: [-200, -200], 0.001: [-350, -350]}
    for rule, expected in {"worst": (0.01, -200, 2, -350, 0), "drop": (0.1, -100, 1, -200, 0)}.items():
        study = grid(SAC, "Acrobot-CA", select=f'diverged = "{rule}"')
        choice = select(study, score(study, lambda t: runs[t.hypers.critic_step_size][t.seed]), {"Acrobot-CA": -1000}).choices[0]
        known = (choice.hypers.critic_step_size, choice.mean, choice.num_seeds, choice.runner_up_mean, choice.num_left_out)
        assert known == expected
        assert choice.diverged == rule
    # (−100 − 500) / 2 = −300 is better than −350
    study = grid(SAC, "Acrobot-CA")
    runs[0.01] = [-900, -900]
    choice = select(study, score(study, lambda t: runs[t.hypers.critic_step_size][t.seed]), {"Acrobot-CA": -500}).choices[0]
    assert (choice.hypers.critic_step_size, choice.mean) == (0.1, -300)


def test_a_setting_of_which_no_run_is_left_is_no_candidate():
    study = grid(SAC, "Acrobot-CA", select='diverged = "drop"')
    runs = {0.1: "diverged", 0.01: -900, 0.001: "diverged"}
    choice = select(study, score(study, lambda t: runs[t.hypers.critic_step_size]), {}).choices[0]
    assert (choice.hypers.critic_step_size, choice.num_settings, choice.num_left_out) == (0.01, 1, 2)
    assert choice.runner_up is choice.runner_up_mean is choice.runner_up_normalized is None


def test_a_setting_with_a_run_that_has_no_score_is_no_candidate():
    study = grid(SAC, "Acrobot-CA", "Pendulum-CA")
    scores = score(study, lambda t: None if t.hypers.critic_step_size == 0.1 and t.environment == "Acrobot-CA" else -1.0)
    counts = {(c.by, c.environment): (c.num_settings, c.num_left_out) for c in select(study, scores, {})}
    assert counts == {
        ("per-environment", "Acrobot-CA"): (2, 1),
        ("per-environment", "Pendulum-CA"): (3, 0),
        ("across-environments", "Acrobot-CA"): (2, 1),
        ("across-environments", "Pendulum-CA"): (2, 1),
    }


def test_a_diverged_run_where_no_episode_was_completed_has_no_score():
    study = grid(SAC, "Acrobot-CA", select='by = ["per-environment"]')
    selection = select(study, score(study, lambda t: "diverged"), {})
    assert (len(selection), selection.messages) == (
        0,
        ["SAC on Acrobot-CA: nothing is chosen per-environment: no setting has all its runs and their scores"],
    )


def test_missing_trials_are_counted_by_agent_and_environment_and_failed_ones_with_them():
    study = grid(SAC + SAC.replace("SAC", "VanillaAC"), "Acrobot-CA", "Pendulum-CA")
    scores = score(study, lambda t: "missing" if t.agent == "SAC" and t.environment == "Pendulum-CA" else -1.0)
    failed = next(trial for trial in expand(study) if trial.agent == "VanillaAC" and trial.environment == "Acrobot-CA")
    scores[failed.id] = TrialScores("failed", None, None)
    with pytest.raises(IncompleteError) as error:
        select(study, scores, {})
    assert isinstance(error.value, UserError)
    assert str(error.value) == (
        "study: nothing can be chosen: 7 of 24 tuning trials are missing or have failed:\n"
        "  SAC on Pendulum-CA: 6 of 6\n"
        "  VanillaAC on Acrobot-CA: 1 of 6\n"
        "`sweep launch` trains them; `--allow-partial` chooses among the settings that lack none"
    )


def test_partial_selection_leaves_out_settings_that_lack_a_run_and_says_where_nothing_is_left():
    study = grid(SAC, "Acrobot-CA", "Pendulum-CA")

    def returns(trial):
        lacks = trial.seed == 1 and (trial.environment == "Pendulum-CA" or trial.hypers.critic_step_size == 0.1)
        return "missing" if lacks else {0.1: 9.0, 0.01: 5.0, 0.001: 7.0}[trial.hypers.critic_step_size]

    selection = select(study, score(study, returns), {}, allow_partial=True)
    (choice,) = selection.choices
    assert (choice.environment, choice.hypers.critic_step_size, choice.num_settings, choice.num_left_out) == (
        "Acrobot-CA",
        0.001,
        2,
        1,
    )
    assert selection.messages == [
        "SAC on Pendulum-CA: nothing is chosen per-environment: no setting has all its runs and their scores",
        "SAC on Acrobot-CA, Pendulum-CA: nothing is chosen across-environments: no setting has all its runs and their scores",
    ]


def test_of_equally_good_settings_the_lowest_hash_is_chosen():
    study = grid(GREEDY, "Acrobot-CA", "Acrobot-DA")
    hashes = {}  # critic step-size and entropy scale → environment → setting
    for trial in expand(study):
        for scale in (0.1, 1.0, 10.0) if trial.environment == "Acrobot-DA" else (trial.hypers.entropy_scale,):
            hashes.setdefault((trial.hypers.critic_step_size, scale), {})[trial.environment] = trial.setting
    together = sorted(hashes.values(), key=lambda known: sorted(known.values()))
    assert len(together) == 6
    for choice in select(study, score(study, lambda t: -1.0), {}):
        alone = sorted({known[choice.environment] for known in hashes.values()})
        ranked = alone if choice.by == "per-environment" else [known[choice.environment] for known in together]
        assert (choice.setting, choice.runner_up, choice.num_tied) == (ranked[0], ranked[1], len(ranked) - 1)


def test_rounding_makes_no_winner_when_the_runs_are_the_same_in_another_order():
    # added from left to right, 0.1 + 0.2 + 0.3 is 0.6000000000000001, and 0.3 + 0.2 + 0.1 is 0.6
    study = grid(SAC, "Acrobot-CA", tune=3)
    runs = {0.1: [0.1, 0.2, 0.3], 0.01: [0.3, 0.2, 0.1], 0.001: [0.2, 0.3, 0.1]}
    selection = select(study, score(study, lambda t: runs[t.hypers.critic_step_size][t.seed]), {})
    assert [choice.num_tied for choice in selection] == [2, 2]


def test_a_choice_is_made_for_each_value_that_is_asked_for():
    agent = '[[agent]]\nname = "GreedyAC"\nsweep = { critic_step_size = [0.1, 0.01], num_action_samples = [10, 20, 30] }\n'
    study = grid(agent + SAC, "Acrobot-CA", "Acrobot-DA", select='for_each = ["num_action_samples"]')

    def returns(trial):
        if trial.agent == "SAC" or trial.environment == "Acrobot-DA":
            return trial.hypers.critic_step_size
        return trial.hypers.critic_step_size * (1 if trial.hypers.num_action_samples == 20 else -1)

    selection = select(study, score(study, returns), {})
    chosen = [
        (c.by, c.environment, c.for_each.get("num_action_samples"), c.hypers.critic_step_size, c.num_settings)
        for c in selection
        if c.agent == "GreedyAC"
    ]
    # across: −0.1 + 0.1 and −0.01 + 0.01 tie for 10 and 30, by G* = 1000 on both
    assert [known for known in chosen if known[0] == "per-environment"] == [
        ("per-environment", "Acrobot-CA", 10, 0.01, 2),
        ("per-environment", "Acrobot-CA", 20, 0.1, 2),
        ("per-environment", "Acrobot-CA", 30, 0.01, 2),
        ("per-environment", "Acrobot-DA", None, 0.1, 2),
    ]
    across = [known for known in chosen if known[0] == "across-environments"]
    assert [known[1:3] for known in across] == [(name, n) for n in (10, 20, 30) for name in ("Acrobot-CA", "Acrobot-DA")]
    assert {known[3] for known in across if known[2] == 20} == {0.1}
    assert all(c.hypers.num_action_samples == c.for_each["num_action_samples"] for c in selection if c.for_each)
    assert sum(choice.agent == "SAC" for choice in selection) == 4 and not any(c.for_each for c in selection if c.agent == "SAC")


def test_a_choice_on_the_edge_of_what_was_swept_is_marked():
    # Table A.1: SAC across environments is at the edge of all three
    agent = (
        '[[agent]]\nname = "SAC"\nsweep = { critic_step_size = [1e-1, 1e-2, 1e-5], actor_step_size_scale = [1e-3, 1.0, 10.0], '
        "entropy_scale = [1e-3, 1.0, 10.0], batch_size = [16, 32], hidden_layers = [[8], [16], [32]] }\n"
    )
    study = grid(agent, "Acrobot-CA", tune=1, select='by = ["per-environment"]')
    printed = {"critic_step_size": 1e-5, "actor_step_size_scale": 10.0, "entropy_scale": 10.0}
    middle = printed | {"critic_step_size": 1e-2, "entropy_scale": 1.0}
    for best, edges in ((printed, tuple(printed)), (middle, ("actor_step_size_scale",))):
        scores = score(study, lambda t, best=best: float(best.items() <= t.hypers.as_dict().items()))
        assert select(study, scores, {}).choices[0].on_edge == edges
