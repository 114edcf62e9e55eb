"""Sensitivity and effective dimensionality as a table: numbers worked out by hand, and what is refused."""

import itertools
import json

import numpy as np
import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures.options import NoDataError, Options
from analysis.tables import sensitivity
from sweep.messages import UserError

MINMAX = Options(normalizer="minmax")


def build(store, options=MINMAX, study="demo"):
    return sensitivity.build(connect(store), study, options)


def test_the_point_of_each_agent_is_that_worked_out_by_hand(two_environments):
    rows = build(two_environments()).data.set_index("agent")
    assert rows.loc["GreedyAC", ["sensitivity", "tuned", "compromise"]].tolist() == pytest.approx([0.35, 1.0, 0.65])
    assert rows.loc["SAC", ["sensitivity", "tuned", "compromise"]].tolist() == pytest.approx([0.0, 0.8, 0.8])
    assert rows["region"].tolist() == ["better only tuned to each environment", "reference"]


def test_luck_that_all_settings_share_widens_the_score_and_not_the_sensitivity(two_environments):
    greedy = build(two_environments()).data.set_index("agent").loc["GreedyAC"]
    # a resample of two seeds has both of either one a quarter of the time: ±5 of 100, on one of two environments
    assert greedy[["tuned_low", "tuned_high"]].tolist() == pytest.approx([0.975, 1.025])
    assert greedy[["sensitivity_low", "sensitivity_high"]].tolist() == pytest.approx([0.35, 0.35])
    assert (greedy["num_settings"], greedy["num_seeds"], greedy["num_environments"]) == (3, 2, 2)


def test_one_hyperparameter_has_to_be_tuned_where_the_compromise_costs_more_than_five_percent(two_environments):
    rows = build(two_environments()).data.set_index("agent")
    assert rows["dimensionality"].tolist() == [1, 0]
    assert rows.loc["GreedyAC", "dimensionality_interpolated"] == pytest.approx((0.95 - 0.65) / (1 - 0.65))
    assert rows.loc["GreedyAC", "best_of_each_number"] == "none: 0.65; critic_step_size: 1"


def test_percentiles_are_the_default_and_the_thesis_normalizer_is_refused_with_the_reason(two_environments):
    store = two_environments()
    assert set(build(store, Options()).data["normalizer"]) == {"percentile"}
    with pytest.raises(UserError, match=r"no lower end.*Choose one of minmax, percentile, cdf"):
        build(store, Options(normalizer="thesis"))


def test_one_seed_has_no_sensitivity(two_environments):
    with pytest.raises(NoDataError, match=r"GreedyAC: .*needs at least two tuning seeds"):
        build(two_environments(luck=(0,)))


def test_one_environment_has_no_sensitivity(two_environments):
    with pytest.raises(NoDataError, match="needs several environments, and there is one"):
        build(two_environments(), Options(environments=("Pendulum-CA",)))


def test_settings_that_lack_a_run_are_left_out_and_said(two_environments):
    table = build(two_environments(missing=1))
    assert table.data.set_index("agent").loc["GreedyAC", "num_settings"] == 2
    assert "GreedyAC: 1 setting left out: without all runs, or not on all environments" in table.notes
    assert "GreedyAC on Pendulum-CA: 5 of 6 trials" in table.notes


def test_without_evaluation_runs_that_is_said(two_environments):
    table = build(two_environments())
    assert "evaluated_sensitivity" not in table.data
    assert any(note.startswith("SAC: no sensitivity on evaluation seeds: ") for note in table.notes)


def test_an_environment_where_settings_do_not_differ_is_left_out_and_said(tmp_path):
    store = SyntheticStore(tmp_path)
    for environment, step_size, seed in itertools.product(("Acrobot-CA", "MountainCar-CA", "Pendulum-CA"), (0.1, 0.01), (0, 1)):
        trial = store.plan("demo", "SAC", environment, seed, critic_step_size=step_size)
        store.finish(trial, [-100.0 if environment == "Acrobot-CA" else step_size])
    table = build(store.write_studies())
    assert table.data["num_environments"].tolist() == [2]
    assert any(note.startswith("SAC: left out: Acrobot-CA: normalizer") for note in table.notes)


def test_evaluation_seeds_of_a_real_study_give_the_difference_of_both_choices(real_store):
    connection = connect(real_store)
    table = sensitivity.build(connection, "chapter-6", Options(normalizer="cdf"))
    runs = connection.execute(
        """
        SELECT chosen_runs.by, chosen_runs.agent, chosen_runs.environment, chosen_runs.seed, study_trials.episode_mean
        FROM chosen_runs
        INNER JOIN study_trials USING (study, stage, trial)
        WHERE study = 'chapter-6' AND stage = 'evaluate'
        """
    ).df()
    tuning = connection.execute("FROM study_trials WHERE study = 'chapter-6' AND stage = 'tune'").df()
    pools = {
        place: [pool.to_numpy() for _, pool in known.groupby("agent")["episode_mean"]]
        for place, known in tuning.groupby("environment")
    }
    below = [
        np.mean([(pool < score).mean() for pool in pools[place]])
        for place, score in zip(runs["environment"], runs["episode_mean"], strict=True)
    ]
    runs = runs.assign(score=below)
    means = runs.groupby(["agent", "by", "environment"])["score"].mean().groupby(["agent", "by"]).mean().unstack()
    expected = means["per-environment"] - means["across-environments"]
    shown = table.data.set_index("agent")["evaluated_sensitivity"]
    assert shown.to_dict() == pytest.approx(expected.to_dict(), abs=1e-9)


def test_the_sql_gives_the_runs_behind_the_table(two_environments):
    store = two_environments()
    table = build(store)
    rows = connect(store).execute(table.sql).fetchall()
    assert len(rows) == 2 * 2 * 3 * 2
    assert json.loads(table.data.to_json(orient="records"))[0]["study"] == rows[0][0] == "demo"


def test_one_complete_candidate_has_a_sensitivity_and_the_reason_why_no_dimensionality(tmp_path):
    store = SyntheticStore(tmp_path)
    for environment, step_size, seed in itertools.product(("MountainCar-CA", "Pendulum-CA"), (0.1, 0.01), (0, 1)):
        for agent in ("GreedyAC", "SAC"):
            trial = store.plan("demo", agent, environment, seed, critic_step_size=step_size)
            if (agent, step_size, seed) != ("SAC", 0.01, 1):
                store.finish(trial, [10 * step_size + seed])
    table = build(store.write_studies())
    row = table.data.set_index("agent").loc["SAC"]
    assert (row["sensitivity"], row["num_settings"]) == (0, 1)
    assert np.isnan(row["dimensionality"])
    assert any("SAC: an effective dimensionality needs a hyperparameter that varies" in note for note in table.notes)


def test_hyperparameters_that_the_study_crossed_stay_two_where_runs_are_missing(tmp_path):
    store = SyntheticStore(tmp_path)
    cells = itertools.product(("MountainCar-CA", "Pendulum-CA"), (0.1, 0.01), (1.0, 10.0), (0, 1))
    for environment, step_size, kappa, seed in cells:
        trial = store.plan("demo", "SAC", environment, seed, critic_step_size=step_size, actor_step_size_scale=kappa)
        if (step_size, kappa) in ((0.1, 1.0), (0.01, 10.0)) or seed == 0:  # the other two lack a run
            store.finish(trial, [50 * step_size + kappa + seed])
    table = build(store.write_studies())
    (best,) = table.data["best_of_each_number"]
    assert [part.split(":")[0] for part in best.split("; ")][-1] == "critic_step_size + actor_step_size_scale"
    assert not any("one hyperparameter here" in note for note in table.notes)


def test_a_study_that_drops_diverged_runs_has_no_sensitivity_where_there_are_any(tmp_path):
    store = SyntheticStore(tmp_path)
    for environment, step_size, seed in itertools.product(("MountainCar-CA", "Pendulum-CA"), (0.1, 0.01), (0, 1)):
        trial = store.plan("demo", "SAC", environment, seed, critic_step_size=step_size)
        store.finish(trial, [float("nan") if (step_size, seed) == (0.1, 1) else 100 * step_size + seed])
    path = store.write_studies()
    (path / "studies" / "demo" / "grid.toml").write_text('[select]\ndiverged = "drop"\n')
    with pytest.raises(NoDataError, match="needs the same seeds of all settings"):
        build(path)
