"""Selection: winners worked out by hand, and by a search that shares no code with the one under test."""

import itertools
import random
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from selection_studies import GREEDY, SAC, grid, score, winners

from agents.registry import find_algorithm
from sweep.normalizers import UndefinedNormalizerError
from sweep.selection import TrialScores, select
from sweep.trials import expand


def test_the_highest_mean_over_seeds_wins_not_the_highest_run():
    study = grid(SAC, "Acrobot-CA", tune=3)
    runs = {0.1: [0, 0, 90], 0.01: [40, 30, 50], 0.001: [39, 39, 39]}  # means 30, 40, 39
    selection = select(study, score(study, lambda trial: runs[trial.hypers.critic_step_size][trial.seed]), {})
    first = selection.choices[0]
    assert (first.hypers.critic_step_size, first.mean, first.num_seeds, first.num_settings) == (0.01, 40, 3, 3)
    assert (first.runner_up_mean, first.num_tied, first.num_left_out) == (39, 0, 0)
    # G* = 1000
    assert (first.normalized, first.runner_up_normalized) == pytest.approx((0.040, 0.039))


def test_across_environments_the_mean_of_normalized_scores_is_maximized():
    study = grid(SAC, "Acrobot-CA", "Pendulum-CA")
    # N = 1 − (G* − p) / |G*|, G* = −50 and 500. Means of N: (−1 + 0.8) / 2, (0 + 0.2) / 2, (−2 + 1) / 2
    runs = {"Acrobot-CA": {0.1: -150, 0.01: -100, 0.001: -200}, "Pendulum-CA": {0.1: 400, 0.01: 100, 0.001: 500}}
    best = {"Acrobot-CA": -50, "Pendulum-CA": 500}
    scores = score(study, lambda t: runs[t.environment][t.hypers.critic_step_size], lambda t: best[t.environment])
    selection = select(study, scores, {})
    assert winners(selection) == {"Acrobot-CA": 0.01, "Pendulum-CA": 0.001}
    assert winners(selection, "across-environments") == {"Acrobot-CA": 0.01, "Pendulum-CA": 0.01}
    across = {choice.environment: choice for choice in selection if choice.by == "across-environments"}
    assert [across[name].mean for name in best] == [-100, 100]
    assert [across[name].runner_up_mean for name in best] == [-150, 400]
    assert [choice.normalized for choice in across.values()] == pytest.approx([0.1, 0.1])
    assert [choice.runner_up_normalized for choice in across.values()] == pytest.approx([-0.1, -0.1])
    assert selection.normalizer.constants() == {name: {"best_return": value} for name, value in best.items()}


def test_the_thesis_and_the_percentile_normalizer_choose_differently_across_environments():
    # thesis, G* = −56 and 930: Acrobot's differences divide by 56, Pendulum's by 930: the better one on Acrobot wins.
    # Among the settings of both agents, it is little better on Acrobot and much worse on Pendulum.
    runs = {
        ("SAC", "Acrobot-CA"): {0.1: -300, 0.01: -330, 0.001: -1000},
        ("SAC", "Pendulum-CA"): {0.1: 600, 0.01: 850, 0.001: 590},
        ("VanillaAC", "Acrobot-CA"): {0.1: -60, 0.01: -900, 0.001: -1000},
        ("VanillaAC", "Pendulum-CA"): {0.1: 610, 0.01: 700, 0.001: 860},
    }
    best = {"Acrobot-CA": -56, "Pendulum-CA": 930}
    # thesis: −300 → −4.36 and 600 → 0.65; −330 → −4.89 and 850 → 0.91: the first. By spread: 30 / 940 < 250 / 270: the second
    for normalizer, winner in {"thesis": 0.1, "minmax": 0.01, "percentile": 0.01}.items():
        study = grid(SAC + SAC.replace("SAC", "VanillaAC"), "Acrobot-CA", "Pendulum-CA", select=f'normalizer = "{normalizer}"')
        scores = score(study, lambda t: runs[t.agent, t.environment][t.hypers.critic_step_size], lambda t: best[t.environment])
        selection = select(study, scores, {})
        chosen = {c.hypers.critic_step_size for c in selection if c.by == "across-environments" and c.agent == "SAC"}
        assert chosen == {winner}, normalizer
        assert {choice.normalizer for choice in selection} == {normalizer}


def test_the_cdf_is_taken_of_runs_and_averaged_afterwards():
    # pooled runs: −100, −95, −90, −85 twice, −80, −75, −70. Shares strictly below, averaged over two seeds:
    # (−100, −70): (0 + 7/8) / 2; (−95, −75): (1/8 + 6/8) / 2; (−90, −80): (2/8 + 5/8) / 2; (−85, −85): 3/8, though its mean
    # return is the same as the others'
    runs = {0.1: [-100, -70], 0.01: [-95, -75], 0.001: [-90, -80], 0.0001: [-85, -85]}
    agent = SAC.replace("0.001]", "0.001, 0.0001]")
    study = grid(agent, "Acrobot-CA", select='normalizer = "cdf"\nby = ["across-environments"]')
    (across,) = select(study, score(study, lambda t: runs[t.hypers.critic_step_size][t.seed]), {}).choices
    assert (across.normalized, across.runner_up_normalized, across.num_tied) == (7 / 16, 7 / 16, 2)


def test_the_best_return_is_that_of_all_agents_and_of_diverged_runs():
    study = grid(SAC + SAC.replace("SAC", "VanillaAC"), "Pendulum-CA", select='diverged = "drop"')
    scores = score(
        study,
        lambda t: "diverged" if t.agent == "VanillaAC" and t.seed == 0 else 10.0,
        lambda t: 700.0 if t.agent == "VanillaAC" and t.seed == 0 else 600.0,
    )
    selection = select(study, scores, {})
    assert selection.normalizer.constants() == {"Pendulum-CA": {"best_return": 700.0}}


def test_an_entropy_scale_that_is_dropped_with_discrete_actions_still_decides_across_environments():
    study = grid(GREEDY, "Acrobot-CA", "Acrobot-DA")
    continuous = {(0.1, 0.1): -900, (0.1, 1.0): -300, (0.1, 10.0): -800, (0.01, 0.1): -250, (0.01, 1.0): -700, (0.01, 10.0): -600}
    discrete = {0.1: -100, 0.01: -400}  # sums: (0.1, 1.0) −400, (0.01, 0.1) −650

    def returns(trial):
        hypers = trial.hypers
        pair = (hypers.critic_step_size, hypers.entropy_scale)
        return continuous[pair] if trial.environment == "Acrobot-CA" else discrete[hypers.critic_step_size]

    selection = select(study, score(study, returns, lambda t: -50.0), {})
    by = {(choice.by, choice.environment): choice for choice in selection}
    assert len(by) == len(selection) == 4
    alone, dropped = by["per-environment", "Acrobot-CA"], by["per-environment", "Acrobot-DA"]
    assert (alone.hypers.critic_step_size, alone.hypers.entropy_scale, alone.num_settings) == (0.01, 0.1, 6)
    assert (dropped.hypers.critic_step_size, dropped.num_settings) == (0.1, 2)
    for environment, mean in {"Acrobot-CA": -300, "Acrobot-DA": -100}.items():
        across = by["across-environments", environment]
        assert (across.hypers.critic_step_size, across.hypers.entropy_scale) == (0.1, 1.0)
        assert (across.num_settings, across.mean) == (6, mean)
    # the same setting where the entropy scale is dropped, whatever its value
    assert by["across-environments", "Acrobot-DA"].setting == dropped.setting


def test_an_undefined_normalizer_matters_only_across_environments():
    select_alone = grid(SAC, "Acrobot-CA", select='by = ["per-environment"]')
    choice = select(select_alone, score(select_alone, lambda t: -1.0, lambda t: 0.0), {}).choices[0]
    assert choice.normalized is choice.runner_up_normalized is None
    both = grid(SAC, "Acrobot-CA")
    with pytest.raises(UndefinedNormalizerError, match='Acrobot-CA: normalizer "thesis" divides by'):
        select(both, score(both, lambda t: -1.0, lambda t: 0.0), {})


def test_sections_of_one_agent_are_compared_where_their_environments_meet():
    continuous = '[[agent]]\nname = "SAC"\nenvironments = ["*-CA"]\nsweep = { critic_step_size = [0.1, 0.01] }\n'
    everywhere = '[[agent]]\nname = "SAC"\nsweep = { critic_step_size = [0.01, 0.001] }\n'
    study = grid(continuous + everywhere, "Acrobot-CA", "Acrobot-DA")
    choices = select(study, score(study, lambda t: t.hypers.critic_step_size), {}).choices
    # 0.1 is the best on CA and is not swept on DA: no candidate across environments
    assert [(c.by, c.environment, c.hypers.critic_step_size, c.num_settings) for c in choices] == [
        ("per-environment", "Acrobot-CA", 0.1, 3),
        ("per-environment", "Acrobot-DA", 0.01, 2),
        ("across-environments", "Acrobot-CA", 0.01, 2),
        ("across-environments", "Acrobot-DA", 0.01, 2),
    ]


def test_no_order_of_the_input_changes_a_choice():
    generator = random.Random(0)
    values = {"critic_step_size": [0.1, 0.01, 0.001], "entropy_scale": [0.1, 1.0, 10.0]}
    known = None
    for _ in range(6):
        for listed in values.values():
            generator.shuffle(listed)
        swept = ", ".join(f"{name} = {listed}" for name, listed in values.items())
        agents = [f'[[agent]]\nname = "{name}"\nsweep = {{ {swept} }}\n' for name in ("GreedyAC", "SAC")]
        environments = ["Acrobot-CA", "Acrobot-DA", "Pendulum-CA"]
        generator.shuffle(agents)
        generator.shuffle(environments)
        study = grid("".join(agents), *environments, tune="[2, 0, 1]" if generator.random() < 0.5 else 3)
        # few values, so that there are ties
        scores = list(score(study, lambda t: float(int(t.id, 16) % 3), lambda t: 3.0).items())
        generator.shuffle(scores)
        chosen = {
            (c.by, c.agent, c.environment): (c.setting, c.runner_up, c.mean, c.normalized)
            for c in select(study, dict(scores), {})
        }
        assert known is None or chosen == known
        known = chosen


@settings(max_examples=60, deadline=None)
@given(st.data(), st.sampled_from(["worst", "drop"]))
def test_a_search_through_all_settings_finds_the_same_winners(data, rule):
    """Exact arithmetic, and values taken from this list, not from the grid."""
    sizes, scales, environments = [0.1, 0.01], [0.1, 1.0], ["Acrobot-CA", "Acrobot-DA", "Pendulum-CA"]
    agent = f"sweep = {{ critic_step_size = {sizes}, entropy_scale = {scales} }}\n"
    study = grid(
        f'[[agent]]\nname = "GreedyAC"\n{agent}[[agent]]\nname = "SAC"\n{agent}',
        *environments,
        select=f'diverged = "{rule}"',
    )
    values = st.one_of(st.integers(-9, 9), st.just("diverged"), st.none())
    table = {}  # (agent, environment, size, scale or None where it is dropped, seed) → return
    scores, hashes = {}, {}
    for trial in expand(study):
        dropped = trial.agent == "GreedyAC" and trial.environment.endswith("-DA")
        scale = None if dropped else trial.hypers.entropy_scale
        place = (trial.agent, trial.environment, trial.hypers.critic_step_size, scale)
        value = table[(*place, trial.seed)] = data.draw(values)
        hashes[place] = trial.setting
        known = TrialScores("diverged" if value == "diverged" else "finished", value if isinstance(value, int) else None, 10.0)
        scores[trial.id] = known
    worst = dict.fromkeys(environments, -20.0)

    def mean(place):
        runs = [table[(*place, seed)] for seed in (0, 1)]
        runs = [
            -20 if run == "diverged" and rule == "worst" else run for run in runs if not (run == "diverged" and rule == "drop")
        ]
        return None if None in runs or not runs else Fraction(sum(runs), len(runs))

    def scale_on(agent, environment, scale):
        return None if agent == "GreedyAC" and environment.endswith("-DA") else scale

    selection = select(study, scores, worst)
    found = {(c.by, c.agent, c.environment): c for c in selection}
    assert len(found) == len(selection)
    for name in ("GreedyAC", "SAC"):
        pairs = list(itertools.product(sizes, scales))
        for environment in environments:
            places = {(name, environment, size, scale_on(name, environment, scale)) for size, scale in pairs}
            ranked = sorted((-mean(place), hashes[place]) for place in places if mean(place) is not None)
            choice = found.get(("per-environment", name, environment))
            assert (choice is None) == (not ranked)
            if choice is not None:
                assert choice.setting == ranked[0][1]
                assert choice.mean == pytest.approx(float(-ranked[0][0]))
                assert (choice.num_settings, choice.num_left_out) == (len(ranked), len(places) - len(ranked))
                assert choice.num_tied == sum(value == ranked[0][0] for value, _ in ranked) - 1
                assert choice.runner_up == (ranked[1][1] if len(ranked) > 1 else None)
        totals = {}
        for size, scale in pairs:
            means = [mean((name, environment, size, scale_on(name, environment, scale))) for environment in environments]
            if None not in means:
                totals[size, scale] = sum(1 - (10 - value) / 10 for value in means) / len(means)
        across = [found.get(("across-environments", name, environment)) for environment in environments]
        assert [choice is None for choice in across] == [not totals] * 3
        if totals:
            best = max(totals.values())
            pair = (across[0].hypers.critic_step_size, across[0].hypers.entropy_scale)
            assert totals[pair] == best  # sums of such small fractions that differ, differ by more than rounding
            assert {choice.hypers for choice in across} == {
                find_algorithm(name).hypers(critic_step_size=pair[0], entropy_scale=pair[1])
            }
            assert [choice.normalized for choice in across] == pytest.approx([float(best)] * 3)
            assert {choice.num_settings for choice in across} == {len(totals)}
