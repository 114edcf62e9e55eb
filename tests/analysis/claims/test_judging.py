"""Windows worked out by hand, and verdicts on runs whose truth is known."""

import math

import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.claims.claims import Side, parse_claims
from analysis.claims.judging import describe, judge
from analysis.claims.runs import Runs

HEAD = "margin = 10\n[best_returns]\nPendulum-CA = 100.0\nPendulum-DA = -50.0\n"
LUCK = (-2.0, -1.0, 0.0, 1.0, 2.0)


def claims(*tests):
    text = HEAD
    for test in tests:
        text += f'[[claim]]\nfigure = "6.1"\nstudy = "s"\nstatement = "so it is"\ntests = [{test}]\n'
    return parse_claims(text)


def runs_of(store, study, agent, environment, mean, **hypers):
    for seed, luck in enumerate(LUCK):
        store.finish(store.plan(study, agent, environment, seed, **hypers), [mean + luck] * 10)


@pytest.fixture
def store(tmp_path):
    return SyntheticStore(tmp_path)


def verdicts(store, *tests):
    connection = connect(store.write_studies())
    rules = claims(*tests)
    try:
        return judge(rules.claims, rules, Runs(connection))
    finally:
        connection.close()


def test_a_window_weighs_each_episode_by_its_steps_in_it(store):
    trial = store.plan("s", "SAC", "Pendulum-CA", 3)
    # steps 1 to 300, 301 to 600, 601 to 900, and 100 that were cut off by the budget
    store.finish(trial, [3.0, 6.0, 12.0, 999.0], ["truncated", "terminated", "truncated", "budget"], [300, 300, 300, 100])
    diverged = store.plan("s", "SAC", "Pendulum-CA", 5)
    store.finish(diverged, [-7.0, math.nan])
    runs = Runs(connect(store.write_studies()))
    side = Side("SAC", "s", "Pendulum-CA")
    worst = -7
    assert runs.means(side, (0.0, 1.0)).tolist() == pytest.approx([7, worst])
    assert runs.means(side, (0.0, 0.5)).tolist() == pytest.approx([(300 * 3 + 200 * 6) / 500, worst])
    assert runs.means(side, (0.5, 0.8)).tolist() == pytest.approx([(100 * 6 + 200 * 12) / 300, worst])
    assert runs.means(side, (0.85, 1.0)).tolist() == pytest.approx([12, worst])


def test_a_run_that_diverged_counts_where_it_completed_nothing_and_one_that_did_not_does_not(store):
    for seed, last in ((0, math.nan), (1, 9.0)):
        store.finish(store.plan("s", "SAC", "Pendulum-CA", seed), [5.0, last], ["truncated", "budget"], [300, 700])
    means = Runs(connect(store.write_studies())).means(Side("SAC", "s", "Pendulum-CA"), (0.9, 1.0))
    assert means.to_dict() == {0: 5.0}  # the worst return; run 1 has none


def test_runs_are_those_of_the_evaluation_stage_and_of_the_hyperparameters_asked_for(store):
    for seed, stage, samples, value in ((0, "tune", 10, 1.0), (1, "evaluate", 10, 2.0), (2, "evaluate", 30, 3.0)):
        trial = store.plan("s", "GreedyAC", "Pendulum-CA", seed, stage, num_action_samples=samples)
        store.finish(trial, [value])
    runs = Runs(connect(store.write_studies()))
    assert runs.means(Side("GreedyAC", "s", "Pendulum-CA"), (0, 1)).tolist() == [2, 3]
    assert runs.means(Side("GreedyAC", "s", "Pendulum-CA", {"num_action_samples": 30}), (0, 1)).tolist() == [3]
    assert runs.means(Side("GreedyAC", "s", "Pendulum-CA", {"entropy_gradient": "sampled"}), (0, 1)).tolist() == [2, 3]


@pytest.mark.parametrize(
    ("test", "verdict"),
    [
        ('{ higher = "SAC", than = "GreedyAC", environment = "Pendulum-CA" }', "confirmed"),
        ('{ higher = "GreedyAC", than = "SAC", environment = "Pendulum-CA" }', "not confirmed"),
        ('{ higher = "VanillaAC", than = "GreedyAC", environment = "Pendulum-CA" }', "undecided"),
        ('{ similar = "VanillaAC", to = "GreedyAC", environment = "Pendulum-CA" }', "confirmed"),
        ('{ similar = "SAC", to = "GreedyAC", environment = "Pendulum-CA" }', "not confirmed"),
        ('{ similar = "SAC-original", to = "GreedyAC", environment = "Pendulum-CA" }', "undecided"),
        ('{ similar = "GreedyAC", to = "SAC-original", environment = "Pendulum-CA" }', "undecided"),
        ('{ at_least = "GreedyAC", as = "VanillaAC", environment = "Pendulum-CA" }', "confirmed"),
        ('{ at_least = "GreedyAC", as = "SAC", environment = "Pendulum-CA" }', "not confirmed"),
        ('{ agent = "SAC", above = 45, environment = "Pendulum-CA" }', "confirmed"),
        ('{ agent = "SAC", above = 51, environment = "Pendulum-CA" }', "undecided"),
        ('{ agent = "SAC", below = 45, environment = "Pendulum-CA" }', "not confirmed"),
        ('{ agent = "SAC", falls_from = [0.0, 0.5], window = "last tenth", environment = "Pendulum-DA" }', "confirmed"),
        ('{ agent = "SAC", falls_from = [0.0, 0.5], window = "last tenth", environment = "Pendulum-CA" }', "undecided"),
        ('{ higher = "SAC", than = "DDPG", environment = "Pendulum-CA" }', "not tested"),
    ],
)
def test_verdicts_on_what_is_known(store, test, verdict):
    for agent, mean in (("SAC", 50.0), ("GreedyAC", 20.0), ("VanillaAC", 20.5), ("SAC-original", 30.0)):
        runs_of(store, "s", agent, "Pendulum-CA", mean)
    for seed, luck in enumerate(LUCK):
        store.finish(store.plan("s", "SAC", "Pendulum-DA", seed), [50 + luck] * 9 + [20 + 2 * luck])
    (judged,) = verdicts(store, test)
    assert judged.verdict == verdict
    assert judged.why == ('study "s" has no run of DDPG on Pendulum-CA yet' if verdict == "not tested" else "")


def test_a_statement_with_several_tests_is_as_weak_as_the_weakest_and_all_are_corrected_together(store):
    for agent, mean in (("SAC", 24.0), ("GreedyAC", 20.0), ("VanillaAC", 20.5)):
        runs_of(store, "s", agent, "Pendulum-CA", mean)
    greedy = '{ higher = "SAC", than = "GreedyAC", environment = "Pendulum-CA" }'
    vanilla = '{ higher = "SAC", than = "VanillaAC", environment = "Pendulum-CA" }'
    both, alone = verdicts(store, f"{greedy}, {vanilla}", greedy)
    assert both.p_value == max(evidence.p_value for evidence in both.evidence)
    assert alone.p_value < both.p_value
    assert (alone.p_holm, both.p_holm) == pytest.approx((2 * alone.p_value, max(both.p_value, 2 * alone.p_value)))


def test_the_price_of_one_setting_for_all_is_in_units_of_the_best_return(store):
    lost = {
        ("SAC", "Pendulum-CA"): 30,
        ("SAC", "Pendulum-DA"): 20,
        ("GreedyAC", "Pendulum-CA"): 10,
        ("GreedyAC", "Pendulum-DA"): 0,
    }
    for (agent, environment), loss in lost.items():
        runs_of(store, "published-per-environment", agent, environment, 50.0)
        runs_of(store, "published-across-environments", agent, environment, 50.0 - loss, critic_step_size=0.5)
    (judged,) = verdicts(store, '{ loses_less = "GreedyAC", than = "SAC" }')
    (evidence,) = judged.evidence
    # GreedyAC (10/100 + 0/50) / 2, SAC (30/100 + 20/50) / 2
    assert evidence.means == pytest.approx((0.05, 0.35))
    assert evidence.estimate.value == pytest.approx(-0.30)
    assert judged.verdict == "confirmed"


def test_regions_are_compared_at_the_step_sizes_asked_for(store):
    for agent, width in (("GreedyAC", 10.0), ("SAC", 40.0)):
        for x, level in ((0.1, 0.0), (0.01, 100.0)):
            for scale in (0.1, 1.0):
                for seed, luck in enumerate((-0.5, 0.5)):
                    extra = width * (scale == 1.0) * (2 if x == 0.01 else 1)
                    hypers = {"critic_step_size": x, "entropy_scale": scale}
                    store.finish(store.plan("s", agent, "Pendulum-CA", seed, **hypers), [level + extra + luck])
    narrower = '{ narrower = "GreedyAC", than = "SAC", environment = "Pendulum-CA" }'
    every, one, dominated = verdicts(
        store,
        narrower,
        narrower.replace(" }", ", at = [0.01] }"),
        '{ dominated = "GreedyAC", environment = "Pendulum-CA" }',
    )
    assert every.evidence[0].estimate.value == pytest.approx(15 - 60)
    assert one.evidence[0].estimate.value == pytest.approx(20 - 80)
    assert dominated.evidence[0].estimate.value == pytest.approx(15 - (110 - 5))
    assert {one.verdict for one in (every, one, dominated)} == {"confirmed"}


def test_an_unfinished_region_is_not_judged(store):
    for agent in ("GreedyAC", "SAC"):
        for scale in (0.1, 1.0):
            for seed in range(2):
                trial = store.plan("s", agent, "Pendulum-CA", seed, critic_step_size=0.1, entropy_scale=scale)
                if (agent, scale, seed) != ("SAC", 1.0, 1):
                    store.finish(trial, [100.0 * scale + seed])
    (judged,) = verdicts(store, '{ narrower = "GreedyAC", than = "SAC", environment = "Pendulum-CA" }')
    assert (judged.verdict, judged.why) == ("not tested", 'study "s" lacks 1 of 4 runs of SAC on Pendulum-CA')


def test_several_tests_need_more_to_refute_a_statement(store):
    runs_of(store, "s", "SAC", "Pendulum-CA", 50.0)
    runs_of(store, "s", "GreedyAC", "Pendulum-CA", 52.6)
    lower = '{ higher = "SAC", than = "GreedyAC", environment = "Pendulum-CA" }'
    certain = '{ agent = "SAC", above = 0, environment = "Pendulum-CA" }'
    alone, two = verdicts(store, lower, f"{lower}, {certain}")
    # Welch: d = -2.6, standard error 1, 8 degrees of freedom: one-sided p 0.0158 of the opposite
    assert alone.evidence[0].p_opposite == pytest.approx(0.0158, abs=5e-5)
    assert (alone.verdict, two.verdict) == ("not confirmed", "undecided")


def test_two_windows_are_compared_on_the_same_runs_only(store):
    for seed, endings in ((0, ["truncated", "budget"]), (1, ["truncated", "truncated"]), (2, ["truncated", "truncated"])):
        store.finish(store.plan("s", "SAC", "Pendulum-CA", seed), [5.0, 4.0 - seed], endings)
    (judged,) = verdicts(store, '{ agent = "SAC", falls_from = [0.0, 0.5], window = "last tenth", environment = "Pendulum-CA" }')
    assert (judged.verdict, judged.why) == ("not tested", "SAC: some runs have no completed episode in one of the two parts")


def test_what_is_compared_is_said_in_words():
    rules = claims(
        '{ higher = "SAC", than = "GreedyAC", environment = "Pendulum-CA", window = "first half" }',
        '{ higher = { agent = "SAC", environment = "A" }, than = { agent = "SAC", environment = "B" } }',
        '{ agent = "SAC", falls_from = [0.4, 0.5], window = "last tenth", environment = "Pendulum-CA" }',
        '{ narrower = "GreedyAC", than = { agent = "GreedyAC", study = "t" }, environment = "E", at = [1e-3] }',
        '{ similar = { agent = "SAC", n = 1 }, to = { agent = "SAC", n = 2 }, environment = "E" }',
    )
    assert [describe(claim.tests[0]) for claim in rules.claims] == [
        "first half: SAC − GreedyAC, Pendulum-CA",
        "all steps: SAC (A) − SAC (B)",
        "last tenth − 40% to 50%: SAC, Pendulum-CA",
        "mean width at critic step-sizes 0.001: GreedyAC (s) − GreedyAC (t), E",
        "all steps: SAC (n = 1) − SAC (n = 2), E",
    ]
