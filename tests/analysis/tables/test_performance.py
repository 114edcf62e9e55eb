"""The performance table against numbers worked out by hand."""

import math

import pytest
from chosen_study import DIVERGED, FAILED, MISSING, same_everywhere, write
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query
from analysis.tables import performance

SCORES = [1, 2, 3, 4, 10]


def built(store, **options):
    return performance.build(connect(store), "study", Options(**options))


def rows(table):
    return {(row["agent"], row["environment"], row["by"]): row for row in table.data.to_dict("records")}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    evaluation = same_everywhere({"GreedyAC": SCORES, "SAC": [3, 3, 3, 3, 3]})
    return write(tmp_path_factory.mktemp("performance") / "store", evaluation)


def test_a_row_is_what_five_runs_come_to(store):
    row = rows(built(store))["GreedyAC", "Pendulum-CA", "per-environment"]
    assert row["num_runs"] == 5
    assert (row["mean"], row["median"], row["iqm"], row["minimum"], row["maximum"]) == (4, 3, 3, 1, 10)
    half = 2.776445 * math.sqrt(12.5 / 5)  # t of 4 degrees of freedom; variance 12.5
    assert (row["low"], row["high"]) == pytest.approx((4 - half, 4 + half), rel=1e-6)
    assert 1 < row["bootstrap_low"] < 4 < row["bootstrap_high"] < 10
    assert row["bootstrap"] == "BCa bootstrap"


def test_the_tolerance_interval_says_what_it_attains(store):
    table = built(store)
    row = rows(table)["GreedyAC", "Pendulum-CA", "per-environment"]
    assert (row["tolerance_low"], row["tolerance_high"]) == (1, 10)
    assert row["tolerance_confidence"] == pytest.approx(1 - 5 * 0.9**4 + 4 * 0.9**5)
    share = row["tolerance_share"]
    assert 1 - 5 * share**4 + 4 * share**5 == pytest.approx(0.95)
    assert any("needs 46 runs" in note and f"{share:.0%}" in note for note in table.notes)


def test_there_is_a_row_for_each_agent_environment_and_regime(store):
    assert len(built(store).data) == 8
    assert {by for *_, by in rows(built(store, by="across-environments"))} == {"across-environments"}
    assert {agent for agent, *_ in rows(built(store, agents=("S*",)))} == {"SAC"}


def test_each_regime_shows_the_setting_that_it_chose(tmp_path):
    evaluation = {
        ("SAC", "Pendulum-CA", "a"): [7, 8],
        ("SAC", "Pendulum-CA", "b"): [5, 6],
        ("SAC", "MountainCar-CA", "b"): [1, 2],
    }
    found = rows(built(write(tmp_path, evaluation, agents=["SAC"])))
    assert found["SAC", "Pendulum-CA", "per-environment"]["mean"] == 7.5
    assert found["SAC", "Pendulum-CA", "across-environments"]["mean"] == 5.5
    assert (
        found["SAC", "MountainCar-CA", "per-environment"]["setting"]
        == found["SAC", "Pendulum-CA", "across-environments"]["setting"]
    )


def test_runs_that_are_all_equal_have_intervals_without_width(store):
    row = rows(built(store))["SAC", "Pendulum-CA", "per-environment"]
    assert [row[name] for name in ("mean", "low", "high", "bootstrap_low", "bootstrap_high")] == [3] * 5


def test_a_diverged_run_is_the_worst_return_and_others_without_a_score_are_counted(tmp_path):
    store = write(tmp_path, same_everywhere({"SAC": [8, DIVERGED, FAILED, MISSING, 5]}), agents=["SAC"])
    table = built(store)
    row = rows(table)["SAC", "Pendulum-CA", "per-environment"]
    assert (row["num_runs"], row["mean"], row["minimum"]) == (3, 5, 2)
    assert (row["diverged"], row["failed"], row["missing"]) == (1, 1, 1)
    said = "SAC on Pendulum-CA, tuned per environment: 1 diverged, counted as the worst return; 1 failed; 1 missing"
    assert said in table.notes


def test_few_runs_are_warned_of_and_ten_are_not(tmp_path):
    few = built(write(tmp_path / "few", same_everywhere({"SAC": [1, 2, 3]}), agents=["SAC"]))
    enough = built(write(tmp_path / "enough", same_everywhere({"SAC": list(range(10))}), agents=["SAC"]))
    assert any("3 runs are few" in note for note in few.notes)
    assert not any("few" in note for note in enough.notes)


def test_one_run_has_no_interval_and_it_is_said_why(tmp_path):
    table = built(write(tmp_path, same_everywhere({"SAC": [4]}), agents=["SAC"]))
    row = rows(table)["SAC", "Pendulum-CA", "per-environment"]
    assert row["mean"] == 4
    assert all(math.isnan(row[name]) for name in ("low", "high", "bootstrap_low", "tolerance_low", "tolerance_share"))
    assert "one run: no interval; it needs two at least" in table.notes


def test_tuning_runs_stand_in_for_evaluation_runs_with_a_warning(tmp_path):
    table = built(write(tmp_path, {}, agents=["SAC"]))
    assert rows(table)["SAC", "Pendulum-CA", "per-environment"]["mean"] == 10
    assert "2 tuning runs each" in table.notes[0]
    assert any("scores are too good" in note for note in table.notes)


def test_a_study_without_a_finished_run_has_no_table(tmp_path):
    store = SyntheticStore(tmp_path)
    store.plan("study", "SAC", "Pendulum-CA", 0)
    with pytest.raises(NoDataError, match="no finished run of a chosen setting: `sweep launch`"):
        built(store.write_studies())
    assert performance.studies(connect(tmp_path), Options()) == []


def test_the_query_gives_the_scores_behind_the_table(store):
    table = built(store)
    found = run_query(store, table.sql).to_pandas()
    here = found[(found["agent"] == "GreedyAC") & (found["environment"] == "Pendulum-CA") & (found["by"] == "per-environment")]
    assert list(here["seed"]) == [10, 11, 12, 13, 14]
    assert list(here["episode_mean"]) == SCORES


def test_the_same_seed_gives_the_same_numbers_and_another_one_others(tmp_path):
    store = write(tmp_path, same_everywhere({"SAC": [math.sqrt(n) for n in range(12)]}), agents=["SAC"])
    first, again, other = (built(store, seed=seed).data["bootstrap_low"][0] for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_it_is_built_from_runs_that_were_trained(real_store):
    table = performance.build(connect(real_store), "chapter-6", Options())
    assert len(table.data) == 24
    assert set(table.data["num_runs"]) == {4}
    assert (table.data["low"] <= table.data["mean"]).all()
    assert (table.data["mean"] <= table.data["high"]).all()
    assert table.text().startswith("agent ")


def test_a_setting_all_of_whose_runs_failed_has_a_row_without_numbers(tmp_path):
    scores = {("SAC", "Pendulum-CA", "a"): [2, 4], ("SAC", "MountainCar-CA", "b"): [FAILED, FAILED]}
    table = built(write(tmp_path, scores, agents=["SAC"]), by="per-environment")
    row = rows(table)["SAC", "MountainCar-CA", "per-environment"]
    assert (row["num_runs"], row["failed"], row["diverged"], row["missing"]) == (0, 2, 0, 0)
    assert all(math.isnan(row[name]) for name in ("mean", "low", "median", "maximum", "tolerance_share"))
    assert "SAC on MountainCar-CA, tuned per environment: 2 failed; no run has a score" in table.notes


def test_a_diverged_run_is_left_out_by_a_study_that_drops_it(tmp_path):
    store = write(tmp_path, same_everywhere({"SAC": [8, DIVERGED, 5]}), agents=["SAC"])
    (store / "studies" / "study" / "grid.toml").write_text('[select]\ndiverged = "drop"\n')
    table = built(store)
    row = rows(table)["SAC", "Pendulum-CA", "per-environment"]
    assert (row["num_runs"], row["mean"], row["minimum"], row["diverged"], row["failed"]) == (2, 6.5, 5, 1, 0)
    assert "SAC on Pendulum-CA, tuned per environment: 1 diverged, left out" in table.notes
