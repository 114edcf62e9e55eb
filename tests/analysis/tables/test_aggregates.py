"""Aggregates over environments against numbers worked out by hand."""

import math

import chosen_study
import numpy as np
import pytest
from chosen_study import DIVERGED, FAILED, same_everywhere, write

from analysis import connect
from analysis.figures.options import NoDataError, Options
from analysis.tables import aggregates

PENDULUM, MOUNTAIN_CAR = [2, 4, 6, 8], [10, 10, 10, 10]
EVALUATION = {
    ("SAC", "Pendulum-CA", "a"): PENDULUM,
    ("SAC", "Pendulum-CA", "b"): [1, 1, 1, 1],
    ("SAC", "MountainCar-CA", "b"): MOUNTAIN_CAR,
}


def built(store, **options):
    return aggregates.build(connect(store), "study", Options(**options))


def found(table, by="per-environment", agent="SAC"):
    rows = table.data[(table.data["by"] == by) & (table.data["agent"] == agent)]
    return {row["statistic"]: row for row in rows.to_dict("records")}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write(tmp_path_factory.mktemp("aggregates") / "store", EVALUATION, agents=["SAC"])


def test_the_aggregates_are_those_of_scores_divided_by_the_best_return(store):
    rows = found(built(store))
    assert rows["mean"]["value"] == pytest.approx((0.5 + 1.0) / 2)
    assert rows["median"]["value"] == pytest.approx((0.5 + 1.0) / 2)
    assert rows["iqm"]["value"] == pytest.approx((0.6 + 0.8 + 1.0 + 1.0) / 4)  # of 8 scores 2 go at each end
    assert rows["optimality_gap"]["value"] == pytest.approx(0.25)
    assert rows["share_failed"]["value"] == 0
    assert {row["num_runs"] for row in rows.values()} == {4}
    assert {row["num_environments"] for row in rows.values()} == {2}


def test_the_regimes_differ_by_the_setting_on_one_environment(store):
    assert found(built(store), "across-environments")["mean"]["value"] == pytest.approx((0.1 + 1.0) / 2)


def test_the_interval_of_the_mean_is_that_of_the_only_environment_that_varies(store):
    row = found(built(store))["mean"]
    means = np.random.default_rng(3).choice([0.2, 0.4, 0.6, 0.8], (100_000, 4)).mean(1)
    low, high = np.quantile((means + 1) / 2, [0.025, 0.975])
    assert (row["low"], row["high"]) == pytest.approx((low, high), abs=0.01)
    assert row["method"] == "stratified bootstrap, paired seeds"


def test_seeds_are_drawn_jointly_where_environments_share_them(tmp_path):
    scores = {("SAC", "Pendulum-CA", "a"): [0, 10] * 4, ("SAC", "MountainCar-CA", "b"): [10, 0] * 4}
    shared = found(built(write(tmp_path / "shared", scores, agents=["SAC"])))["mean"]
    # what a seed loses on one environment it gains on the other
    assert (shared["low"], shared["high"]) == pytest.approx((0.5, 0.5))
    table = built(write(tmp_path / "own", scores, agents=["SAC"], first_seeds={"Pendulum-CA": 50}))
    assert found(table)["mean"]["low"] < 0.4
    assert any("seeds differ between environments" in note for note in table.notes)


def test_without_a_failure_the_interval_of_their_share_is_clopper_pearson(store):
    row = found(built(store))["share_failed"]
    assert (row["low"], row["high"]) == pytest.approx((0, 1 - 0.025 ** (1 / 8)))
    assert row["method"] == "Clopper–Pearson"


def test_diverged_and_failed_runs_are_the_share_that_failed(tmp_path):
    scores = same_everywhere({"SAC": [DIVERGED, FAILED, 6, 8]})
    row = found(built(write(tmp_path, scores, agents=["SAC"])))
    assert row["share_failed"]["value"] == 0.5
    assert 0 <= row["share_failed"]["low"] < 0.5 < row["share_failed"]["high"] <= 1
    assert row["mean"]["value"] == pytest.approx((2 + 6 + 8) / 30)


def test_only_environments_that_all_agents_have_count(tmp_path):
    scores = EVALUATION | {("GreedyAC", "Pendulum-CA", "a"): [5, 6, 7, 8], ("GreedyAC", "Pendulum-CA", "b"): [5, 6, 7, 8]}
    table = built(write(tmp_path, scores))
    assert found(table)["mean"]["value"] == pytest.approx(0.5)
    assert found(table)["mean"]["num_environments"] == 1
    assert "tuned per environment: left out, since not all agents have scores there: MountainCar-CA" in table.notes


def test_agents_without_a_common_environment_have_no_aggregate(tmp_path):
    scores = {("SAC", "MountainCar-CA", "b"): [1, 2], ("GreedyAC", "Pendulum-CA", "a"): [1, 2]}
    store = write(tmp_path, scores)
    with pytest.raises(NoDataError, match="no environment is common to GreedyAC, SAC; choose agents with --agent"):
        built(store, by="per-environment")


def test_another_normalizer_gives_other_numbers_and_is_named(store):
    table = built(store, normalizer="minmax")  # settings' means reach from 2 to 10
    assert found(table)["mean"]["value"] == pytest.approx(((5 - 2) / 8 + 1) / 2)
    assert set(table.data["normalizer"]) == {"minmax"}
    assert "normalizer minmax" in table.notes[0]
    assert not any("does not weigh" in note for note in table.notes)
    assert any("does not weigh environments equally" in note for note in built(store).notes)


def test_an_undefined_normalizer_is_refused_with_a_way_out(tmp_path, monkeypatch):
    zero = {"a": {"Pendulum-CA": 0, "MountainCar-CA": -2}, "b": {"Pendulum-CA": -1, "MountainCar-CA": 0}}
    monkeypatch.setattr(chosen_study, "TUNING", zero)
    store = write(tmp_path, EVALUATION, agents=["SAC"])
    with pytest.raises(NoDataError, match=r'divides by .*G.*choose "minmax", "percentile" or "cdf" with --normalizer'):
        built(store, by="per-environment")
    assert len(built(store, by="per-environment", normalizer="cdf").data) == 5


def test_one_run_has_values_without_intervals(tmp_path):
    table = built(write(tmp_path, same_everywhere({"SAC": [5]}), agents=["SAC"]))
    row = found(table)["iqm"]
    assert row["value"] == pytest.approx(0.5)
    assert math.isnan(row["low"])
    assert math.isnan(row["high"])


def test_it_is_built_from_runs_that_were_trained(real_store):
    table = aggregates.build(connect(real_store), "chapter-6", Options(normalizer="cdf"))
    assert len(table.data) == 2 * 3 * 5
    assert (table.data["low"] <= table.data["value"]).all()
    assert (table.data["value"] <= table.data["high"]).all()
    means = table.data[table.data["statistic"] == "mean"].set_index(["by", "agent"])["value"]
    gaps = table.data[table.data["statistic"] == "optimality_gap"].set_index(["by", "agent"])["value"]
    assert (means + gaps).to_numpy() == pytest.approx(1)  # no score of cdf is above 1


def test_an_environment_where_every_run_failed_counts_as_failed_and_nowhere_else(tmp_path):
    scores = {
        ("SAC", "Pendulum-CA", "a"): [2, 4, 6, 8],
        ("SAC", "MountainCar-CA", "b"): [FAILED] * 4,
        ("GreedyAC", "Pendulum-CA", "a"): [5, 5, 5, 5],
        ("GreedyAC", "MountainCar-CA", "b"): [10, 10, 10, 10],
    }
    table = built(write(tmp_path, scores), by="per-environment")
    sac, greedy = found(table), found(table, agent="GreedyAC")
    assert (sac["share_failed"]["value"], sac["share_failed"]["num_environments"]) == (0.5, 2)
    assert (greedy["share_failed"]["value"], greedy["share_failed"]["num_environments"]) == (0, 2)
    assert (sac["mean"]["value"], sac["mean"]["num_environments"]) == (pytest.approx(0.5), 1)
    assert greedy["mean"]["value"] == pytest.approx(0.5)
    said = "SAC on MountainCar-CA, tuned per environment: 4 failed; no run has a score: left out but for share_failed"
    assert said in table.notes


def test_runs_that_are_left_out_because_they_diverged_are_among_those_that_failed(tmp_path):
    store = write(tmp_path, same_everywhere({"SAC": [DIVERGED, 4, 6, 8]}), agents=["SAC"])
    (store / "studies" / "study" / "grid.toml").write_text('[select]\ndiverged = "drop"\n')
    rows = found(built(store))
    assert rows["share_failed"]["value"] == 0.25
    assert rows["mean"]["value"] == pytest.approx(0.6)
