"""How certain choices are: probabilities, leads and biases of tiny studies that can be worked out."""

import itertools

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures.options import NoDataError, Options
from analysis.tables import selection
from sweep import schema

PER_ENVIRONMENT = Options(by="per-environment")


def study(path, scores, evaluated=()):
    """SAC on Pendulum: critic step-size → the score of each tuning seed (None: missing); evaluation scores of the largest."""
    store = SyntheticStore(path / "store")
    for step_size, values in scores.items():
        for seed, value in enumerate(values):
            trial = store.plan("demo", "SAC", "Pendulum-CA", seed, critic_step_size=step_size)
            if value is not None:
                store.finish(trial, [float(value)])
    for seed, value in enumerate(evaluated):
        trial = store.plan("demo", "SAC", "Pendulum-CA", 100 + seed, "evaluate", critic_step_size=max(scores))
        store.finish(trial, [float(value)])
    return store.write_studies()


def build(store, options=PER_ENVIRONMENT, study="demo"):
    return selection.build(connect(store), study, options)


def test_a_setting_that_is_better_on_every_seed_always_wins_and_costs_no_bias(tmp_path):
    (row,) = build(study(tmp_path, {0.1: [10, 30, 20, 40], 0.01: [0, 20, 10, 30]})).data.to_dict("records")
    assert (row["win_probability"], row["uncertainty_set"], row["num_settings"], row["num_seeds"]) == (1.0, 1, 2, 4)
    assert (row["lead"], row["lead_low"], row["lead_high"]) == pytest.approx((10, 10, 10))
    assert row["tuning_mean"] == 25
    assert (row["bias_bootstrap"], row["bias_split_half"], row["bias_gaussian"]) == pytest.approx((0, 0, 0), abs=1e-9)


def test_a_setting_wins_as_often_as_its_seed_is_drawn(tmp_path):
    table = build(study(tmp_path, {0.1: [0, 10], 0.01: [9, 0]}))
    (row,) = table.data.to_dict("records")
    # of four equally likely resamples only that of seed 0 twice has another winner
    assert row["win_probability"] == pytest.approx(0.75, abs=0.05)
    assert row["uncertainty_set"] == 2
    assert (row["lead"], row["lead_low"], row["lead_high"]) == pytest.approx((0.5, -9, 10))
    assert "warning: several settings win at least 5 % of the resamples: SAC on Pendulum-CA" in table.notes


def test_the_gaussian_reference_is_that_of_two_equal_settings(tmp_path):
    (row,) = build(study(tmp_path, {0.1: [0, 10], 0.01: [9, 0]})).data.to_dict("records")
    # differences 9 and −10 of two settings: σ² of a run about its setting is half the variance of the difference
    noise = np.sqrt(np.var([9, -10], ddof=1) / 2)
    assert row["noise"] == pytest.approx(noise)
    assert row["bias_gaussian"] == pytest.approx(noise / np.sqrt(2) / np.sqrt(np.pi))  # E max of two normals is 1/√π


def test_evaluation_runs_of_the_winner_stand_beside_its_tuning_mean(tmp_path):
    (row,) = build(study(tmp_path, {0.1: [20, 20], 0.01: [0, 0]}, evaluated=[10, 14])).data.to_dict("records")
    assert (row["tuning_mean"], row["evaluation_mean"], row["num_evaluation_seeds"]) == (20, 12, 2)
    half = 12.7062047 * np.sqrt(2)  # Student's 97.5 % quantile of one degree of freedom × 2/√2 · …
    assert (row["evaluation_low"], row["evaluation_high"]) == pytest.approx(
        (12 - half * np.sqrt(2), 12 + half * np.sqrt(2)), rel=1e-6
    )


def test_one_seed_has_no_probabilities_and_no_intervals(tmp_path):
    table = build(study(tmp_path, {0.1: [20], 0.01: [0]}))
    (row,) = table.data.to_dict("records")
    assert row["tuning_mean"] == 20
    assert np.isnan([row["win_probability"], row["lead_low"], row["bias_bootstrap"]]).all()
    assert "SAC on Pendulum-CA: one tuning seed: nothing to resample, so neither probabilities nor intervals" in table.notes


def test_a_setting_that_lacks_a_run_is_left_out(tmp_path):
    table = build(study(tmp_path, {0.1: [20, None], 0.01: [0, 0], 0.001: [5, 5]}))
    assert table.data["tuning_mean"].tolist() == [5]
    assert "SAC on Pendulum-CA: 1 setting left out: without all runs, or not on all environments" in table.notes


def test_nothing_complete_is_no_choice(tmp_path):
    with pytest.raises(NoDataError, match="no setting has all of its runs"):
        build(study(tmp_path, {0.1: [20, None], 0.01: [0, None]}))


def test_across_environments_the_compromise_wins(two_environments):
    table = build(two_environments(), Options(by="across-environments", normalizer="minmax"))
    rows = table.data.set_index("agent")
    assert rows.loc["GreedyAC", "tuning_mean"] == pytest.approx(0.65)
    assert rows.loc["GreedyAC", ["lead", "lead_low", "lead_high"]].tolist() == pytest.approx([0.15, 0.15, 0.15])
    assert set(rows["environment"]) == {"2 environments"}


def test_both_regimes_are_shown_and_agree_with_the_frozen_selection_of_a_real_study(real_store):
    table = build(real_store, Options(), "chapter-6")
    frozen = connect(real_store).execute(
        "SELECT agent, environment, setting, mean FROM selections WHERE study = 'chapter-6' AND \"by\" = 'per-environment'"
    )
    expected = {(agent, environment): (setting, mean) for agent, environment, setting, mean in frozen.fetchall()}
    rows = table.data[table.data["by"] == "per-environment"]
    shown = {(row.agent, row.environment): (row.setting, pytest.approx(row.tuning_mean)) for row in rows.itertuples()}
    assert shown == expected
    across = table.data[table.data["by"] == "across-environments"]
    assert set(across["agent"]) == {agent for agent, _ in expected}
    assert set(table.data["num_evaluation_seeds"]) == {4}


def test_a_study_that_chooses_across_environments_alone_shows_its_evaluation_runs(tmp_path):
    store = SyntheticStore(tmp_path)
    settings = {}
    for environment, x, seed in itertools.product(("MountainCar-CA", "Pendulum-CA"), (0.1, 0.01), (0, 1)):
        trial = store.plan("demo", "SAC", environment, seed, critic_step_size=x)
        store.finish(trial, [100 * x])
        settings[x] = trial["setting"]
    for environment, seed in itertools.product(("MountainCar-CA", "Pendulum-CA"), (10, 11)):
        store.finish(store.plan("demo", "SAC", environment, seed, "evaluate", critic_step_size=0.1), [4 + 2 * (seed - 10)])
    path = store.write_studies()
    frozen = {"study": "demo", "agent": "SAC", "by": "across-environments", "setting": settings[0.1], "score": "episode_mean"}
    frozen |= {"normalizer": "thesis", "diverged": "worst", "basis": "0" * 16, "for_each": "{}", "hypers": "{}"}
    rows = [{**frozen, "environment": place, "constants": '{"best_return": 10.0}'} for place in ("MountainCar-CA", "Pendulum-CA")]
    pq.write_table(pa.Table.from_pylist(rows, schema.SELECTIONS), path / "studies" / "demo" / "selections.parquet")
    (row,) = build(path, Options(by="across-environments")).data.to_dict("records")
    assert (row["evaluation_mean"], row["num_evaluation_seeds"]) == (pytest.approx(0.5), 2)
