"""Differences between agents and regimes against numbers worked out by hand."""

import itertools
import math

import chosen_study
import numpy as np
import pytest
from chosen_study import same_everywhere, write
from scipy import stats

from analysis import connect
from analysis.figures.options import NoDataError, Options
from analysis.tables import comparison

GREEDY, SAC = [5.0, 6.5, 7.0, 9.0, 4.0, 8.0], [4.0, 6.0, 5.0, 9.5, 1.0, 6.0]


def built(store, **options):
    return comparison.build(connect(store), "study", Options(**options))


def row(table, first, environment, by=None):
    found = [
        known
        for known in table.data.to_dict("records")
        if known["first"] == first and known["environment"] == environment and by in (None, known["by"])
    ]
    assert len(found) == 1
    return found[0]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write(tmp_path_factory.mktemp("comparison") / "store", same_everywhere({"GreedyAC": GREEDY, "SAC": SAC}))


@pytest.fixture(scope="module")
def table(store):
    return built(store)


def sign_flips(differences):
    """The p-value of the paired permutation test: of all 2ⁿ ways to swap pairs, those at least as extreme."""
    means = [abs(np.dot(signs, differences)) for signs in itertools.product([1, -1], repeat=len(differences))]
    return np.mean(np.array(means) >= abs(sum(differences)) - 1e-12)


def test_a_pair_of_agents_is_compared_seed_by_seed(table):
    found = row(table, "GreedyAC", "Pendulum-CA", "per-environment")
    differences = np.subtract(GREEDY, SAC)
    assert (found["second"], found["num_runs"], found["interval"]) == ("SAC", 6, "paired Student")
    assert found["difference"] == pytest.approx(differences.mean())
    interval = stats.ttest_rel(GREEDY, SAC).confidence_interval(0.95)
    assert (found["low"], found["high"]) == pytest.approx((interval.low, interval.high))
    assert found["p_value"] == pytest.approx(sign_flips(differences))
    assert found["test"] == "paired permutation"


def test_from_ten_pairs_on_the_interval_is_a_bootstrap(tmp_path):
    greedy, sac = [5.0 + n % 4 for n in range(10)], [4.0 + n % 3 for n in range(10)]
    found = row(
        built(write(tmp_path, same_everywhere({"GreedyAC": greedy, "SAC": sac}))), "GreedyAC", "Pendulum-CA", "per-environment"
    )
    assert found["interval"] == "paired bootstrap"
    means = np.random.default_rng(5).choice(np.subtract(greedy, sac), (100_000, 10)).mean(1)
    assert (found["low"], found["high"]) == pytest.approx(tuple(np.quantile(means, [0.025, 0.975])), abs=0.03)


def test_effect_sizes_are_those_of_the_two_groups(table):
    found = row(table, "GreedyAC", "Pendulum-CA", "per-environment")
    pooled = math.sqrt((np.var(GREEDY, ddof=1) + np.var(SAC, ddof=1)) / 2)
    assert found["cohens_d"] == pytest.approx((np.mean(GREEDY) - np.mean(SAC)) / pooled)
    wins = [(x > y) + 0.5 * (x == y) for x in GREEDY for y in SAC]
    assert found["p_superiority"] == pytest.approx(np.mean(wins))


def test_over_all_environments_normalized_scores_are_compared(table):
    found = row(table, "GreedyAC", "all", "per-environment")
    assert found["scale"] == "thesis"
    assert found["difference"] == pytest.approx(np.subtract(GREEDY, SAC).mean() / 10)
    assert (found["first_mean"], found["second_mean"]) == pytest.approx((np.mean(GREEDY) / 10, np.mean(SAC) / 10))


def test_over_all_environments_seeds_are_drawn_jointly(tmp_path):
    scores = same_everywhere({"GreedyAC": [5] * 6}) | {
        ("SAC", "Pendulum-CA", "a"): [0, 10] * 3,
        ("SAC", "Pendulum-CA", "b"): [0, 10] * 3,
        ("SAC", "MountainCar-CA", "b"): [10, 0] * 3,
    }
    found = row(built(write(tmp_path / "shared", scores)), "GreedyAC", "all", "per-environment")
    # what a seed loses on one environment it gains on the other
    assert (found["difference"], found["low"], found["high"]) == pytest.approx((0, 0, 0))
    assert found["p_superiority"] == pytest.approx(0.5)
    apart = built(write(tmp_path / "apart", scores, first_seeds={"Pendulum-CA": 50}))
    found = row(apart, "GreedyAC", "all", "per-environment")
    assert found["low"] < -0.05 < 0.05 < found["high"]
    assert found["interval"] == "stratified bootstrap"
    assert math.isnan(found["p_value"])


def test_the_price_of_one_setting_for_all_environments_is_shown(tmp_path):
    tuned, compromise = [9.0, 8.0, 8.5, 9.5], [4.0, 6.0, 5.0, 7.0]
    scores = {
        ("SAC", "Pendulum-CA", "a"): tuned,
        ("SAC", "Pendulum-CA", "b"): compromise,
        ("SAC", "MountainCar-CA", "b"): [3, 4, 5, 6],
    }
    table = built(write(tmp_path, scores, agents=["SAC"]))
    found = row(table, "SAC, per environment", "Pendulum-CA")
    assert (found["second"], found["by"]) == ("SAC, across environments", "both")
    assert found["difference"] == pytest.approx(np.subtract(tuned, compromise).mean())
    same = row(table, "SAC, per environment", "MountainCar-CA")
    assert (same["difference"], same["low"], same["high"], same["interval"]) == (0, 0, 0, "same runs")
    assert math.isnan(same["p_value"])
    assert same["num_tests"] == 0
    assert row(table, "SAC, per environment", "all")["difference"] == pytest.approx(np.subtract(tuned, compromise).mean() / 20)


def test_different_seeds_are_compared_by_welch(tmp_path):
    store = write(tmp_path, same_everywhere({"GreedyAC": GREEDY, "SAC": [*SAC, 5.0]}))
    table = built(store, by="per-environment")
    found = row(table, "GreedyAC", "Pendulum-CA")
    expected = stats.ttest_ind(GREEDY, [*SAC, 5.0], equal_var=False)
    assert (found["test"], found["interval"], found["num_runs"]) == ("Welch", "Welch", 6)
    assert found["p_value"] == pytest.approx(expected.pvalue)
    assert (found["low"], found["high"]) == pytest.approx(tuple(expected.confidence_interval()))
    assert "where the two sides have different seeds, runs are not paired" in table.notes


def test_p_values_are_corrected_within_their_family(table):
    pair = [row(table, "GreedyAC", place, "per-environment") for place in ("Pendulum-CA", "MountainCar-CA")]
    # the same scores on both: Holm doubles the two equal p-values, Benjamini and Hochberg would not
    assert [known["p_holm"] for known in pair] == pytest.approx([2 * known["p_value"] for known in pair])
    assert {known["num_tests"] for known in pair} == {2}
    everywhere = row(table, "GreedyAC", "all", "per-environment")
    assert (everywhere["num_tests"], everywhere["p_holm"]) == (1, everywhere["p_value"])
    assert {known["family"] for known in pair} == {"agents, tuned per environment, each environment"}


def test_one_setting_for_all_environments_costs_nothing_where_it_is_the_best_on_each(tmp_path, monkeypatch):
    tuning = {"a": dict.fromkeys(chosen_study.ENVIRONMENTS, 5), "b": dict.fromkeys(chosen_study.ENVIRONMENTS, 10)}
    monkeypatch.setattr(chosen_study, "TUNING", tuning)
    table = built(write(tmp_path, {("SAC", place, "b"): SAC for place in chosen_study.ENVIRONMENTS}, agents=["SAC"]))
    assert set(table.data["environment"]) == {"all", *chosen_study.ENVIRONMENTS}
    assert set(table.data["interval"]) == {"same runs"}
    assert (table.data["difference"] == 0).all()
    assert table.data["p_value"].isna().all()


def test_it_says_how_small_a_p_value_the_runs_allow(table):
    assert any("permutation test of 6 runs gives no p-value below 0.0312" in note for note in table.notes)


def test_one_run_gives_a_difference_without_interval_or_p_value(tmp_path):
    found = row(
        built(write(tmp_path, same_everywhere({"GreedyAC": [5], "SAC": [3]}))), "GreedyAC", "Pendulum-CA", "per-environment"
    )
    assert (found["difference"], found["interval"]) == (2, "none")
    assert all(math.isnan(found[name]) for name in ("low", "high", "p_value", "p_holm"))


def test_an_undefined_normalizer_leaves_the_single_environments(tmp_path, monkeypatch):
    zero = {"a": {"Pendulum-CA": 0, "MountainCar-CA": -2}, "b": {"Pendulum-CA": -1, "MountainCar-CA": 0}}
    monkeypatch.setattr(chosen_study, "TUNING", zero)
    table = built(write(tmp_path, same_everywhere({"GreedyAC": GREEDY, "SAC": SAC})), by="per-environment")
    assert set(table.data["environment"]) == {"Pendulum-CA", "MountainCar-CA"}
    assert any(note.startswith("no row over all environments") for note in table.notes)


def test_a_single_agent_under_one_regime_cannot_be_compared(store):
    with pytest.raises(NoDataError, match="needs two agents, or one tuned in both ways"):
        built(store, agents=("SAC",), by="per-environment")


def test_choices_for_several_values_are_compared_with_one_another(real_store):
    table = comparison.build(connect(real_store), "figure-7-2", Options())
    names = {f"GreedyAC, num_action_samples = {count}" for count in (10, 20, 30)}
    assert {*table.data["first"], *table.data["second"]} == names
    assert set(table.data["num_runs"]) == {3}


def test_it_is_built_from_runs_that_were_trained(real_store):
    table = comparison.build(connect(real_store), "chapter-6", Options(normalizer="cdf"))
    pairs, agents, places = 3, 3, 4
    assert len(table.data) == (2 * pairs + agents) * (places + 1)
    assert (table.data["p_holm"].dropna() >= table.data["p_value"].dropna()).all()
