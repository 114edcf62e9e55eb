"""Scores, normalizers and choices: the views against `sweep.selection` and `sweep.normalizers`, and against tables by hand."""

import dataclasses
import math

import numpy as np
import pytest
from selection_studies import GREEDY, SAC, grid
from synthetic_store import SyntheticStore, digest

from analysis import connect
from sweep.normalizers import NORMALIZERS, Normalizer, UndefinedNormalizerError
from sweep.selection import select
from sweep.selections import basis, gather_scores, table, write_selection
from sweep.store import Store
from sweep.trials import evaluation_trials, expand
from sweep.tuning import measure, normalizer

ENVIRONMENTS = ("Pendulum-CA", "MountainCar-DA", "Acrobot-CA")
THREE = '[[agent]]\nname = "VanillaAC"\nsweep = { critic_step_size = [0.1, 0.01, 0.001] }\n'


def rows(store, sql):
    connection = connect(store)
    try:
        return connection.sql(sql).to_arrow_table().to_pylist()
    finally:
        connection.close()


def random_run(generator, spread):
    """Returns and endings of a run: often a whole number, so that means tie; some diverge, some complete nothing."""
    kind = generator.random()
    values = [float(-generator.integers(1, spread)) for _ in range(2)]
    if kind < 0.08:
        return [values[0], math.nan], ()
    if kind < 0.12:
        return [values[0]], ["budget"]
    return values, ()


def random_store(path, study, seed, spread=40, missing=0.05):
    """A store with the tuning trials of a study, all but some."""
    generator = np.random.default_rng(seed)
    synthetic = SyntheticStore(path)
    runs = {}
    for trial in expand(study):
        member = synthetic.plan_trial(study.name, trial)
        if generator.random() >= missing:
            runs.setdefault(trial.agent, []).append((member, *random_run(generator, spread)))
    for together in runs.values():
        synthetic.finish_together(together)
    synthetic.write_studies()
    return Store.open(path)


def chosen_by_code(study, store):
    return select(study, *gather_scores(store, expand(study), study.select.score), allow_partial=True)


def assert_same_choices(store, by, choices):
    view = {"per-environment": "tuned_per_environment", "across-environments": "tuned_across_environments"}[by]
    found = {(row["agent"], row["environment"]): row for row in rows(store.path, f"FROM {view}")}
    expected = {(choice.agent, choice.environment): choice for choice in choices if choice.by == by}
    assert found.keys() == expected.keys() and expected
    for place, choice in expected.items():
        row = found[place]
        for name in ("setting", "num_seeds", "num_settings", "num_left_out", "runner_up", "num_tied", "score"):
            assert row[name] == getattr(choice, name), (place, name)
        for name in ("mean", "runner_up_mean"):
            value = getattr(choice, name)
            assert row[name] == (value if value is None else pytest.approx(value, rel=1e-12)), (place, name)
        assert set(row["on_edge"]) == set(choice.on_edge), place
        assert (row["source"], row["is_frozen"], row["for_each"]) == ("computed", False, "{}")
        assert row["critic_step_size"] == choice.hypers.critic_step_size
        if by == "across-environments":
            assert row["normalized"] == pytest.approx(choice.normalized, rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_computed_choices_are_those_that_selection_makes(tmp_path, seed):
    study = grid(GREEDY + SAC + THREE, *ENVIRONMENTS, tune=3)
    store = random_store(tmp_path, study, seed, spread=5 if seed % 2 else 40)
    for by in ("per-environment", "across-environments"):
        assert_same_choices(store, by, chosen_by_code(study, store))


@pytest.mark.parametrize(
    ("normalizer", "diverged"),
    [("minmax", "worst"), ("percentile", "drop"), ("cdf", "worst"), ("thesis", "drop"), ("cdf", "drop")],
)
def test_choices_across_environments_are_by_the_rules_of_the_studys_selection(tmp_path, normalizer, diverged):
    rules = f'by = ["per-environment"]\nnormalizer = "{normalizer}"\ndiverged = "{diverged}"'
    study = grid(GREEDY + SAC, *ENVIRONMENTS, tune=3, select=rules)
    store = random_store(tmp_path, study, 7, missing=0.03)
    frozen = chosen_by_code(study, store)
    constants = frozen.normalizer.constants()
    write_selection(store, "study", table("study", frozen, basis(study, expand(study)), constants))
    by = dataclasses.replace(study.select, by=("across-environments",))
    expected = chosen_by_code(dataclasses.replace(study, select=by), store)
    assert_same_choices(store, "across-environments", expected)
    (rule,) = rows(store.path, "FROM study_rules")
    named = {"score": "episode_mean", "normalizer": normalizer, "diverged": diverged, "by": ["per-environment"]}
    assert rule == {"study": "study", **named}


@pytest.mark.parametrize("diverged", ["worst", "drop"])
def test_before_anything_is_frozen_choices_are_by_the_rules_of_the_grid(tmp_path, diverged):
    rules = f'score = "step_mean"\nnormalizer = "cdf"\ndiverged = "{diverged}"'
    study = grid(GREEDY + SAC, *ENVIRONMENTS, tune=3, select=rules)
    store = random_store(tmp_path, study, 11, missing=0.03)
    (tmp_path / "studies" / "study" / "grid.toml").write_text(study.text)
    for by in ("per-environment", "across-environments"):
        assert_same_choices(store, by, chosen_by_code(study, store))


def test_runs_are_shown_by_the_kinds_of_choices_that_a_grid_with_evaluation_asks_for(tmp_path):
    study = grid(SAC, "Pendulum-CA", select='by = ["across-environments"]')
    random_store(tmp_path, study, 3, missing=0.0)
    file = tmp_path / "studies" / "study" / "grid.toml"
    shown = []
    for evaluated in ("", "evaluate = 2\n"):
        file.write_text(study.text.replace("[select]", f"{evaluated}[select]"))
        shown.append([row["by"] for row in rows(tmp_path, 'SELECT DISTINCT "by" FROM chosen_runs ORDER BY ALL')])
    assert shown == [["across-environments", "per-environment"], ["across-environments"]]


@pytest.mark.parametrize(("diverged", "expected"), [("worst", -9.0), ("drop", None)])
def test_every_score_of_a_diverged_run_follows_the_rule_of_its_study(tmp_path, diverged, expected):
    store = SyntheticStore(tmp_path)
    means = {"episode_mean": -1.0, "step_mean": -2.0, "final_mean": -3.0}
    for seed, returns in enumerate(([-9.0, math.nan], [-4.0])):
        columns = means if seed else {}
        member = store.plan("s", "SAC", "Pendulum-CA", seed)
        store.finish(member, returns, **columns)
    (store.write_studies() / "studies" / "s" / "grid.toml").write_text(
        f'[select]\ndiverged = "{diverged}"\nscore = "final_mean"\n'
    )
    first, second = rows(tmp_path, "SELECT episode_mean, step_mean, final_mean, score, is_dropped FROM run_scores ORDER BY seed")
    assert list(first.values()) == [expected] * 4 + [diverged == "drop"]
    assert second == {**means, "score": -3.0, "is_dropped": False}


def test_frozen_choices_go_before_those_that_could_be_made_now(tmp_path):
    study = grid(GREEDY, *ENVIRONMENTS, select='for_each = ["entropy_scale"]')
    store = random_store(tmp_path, study, 1, missing=0.0)
    frozen = chosen_by_code(study, store)
    write_selection(store, "study", table("study", frozen, basis(study, expand(study)), frozen.normalizer.constants()))
    for by, view in (("per-environment", "tuned_per_environment"), ("across-environments", "tuned_across_environments")):
        names = "agent, environment, for_each, setting, mean, num_seeds, runner_up, num_tied, on_edge"
        found = rows(store.path, f"SELECT {names} FROM {view} ORDER BY ALL")
        kept = rows(store.path, f"SELECT {names} FROM selections WHERE \"by\" = '{by}' ORDER BY ALL")
        assert found == kept and len(kept) > 4
        assert {row["source"] for row in rows(store.path, f"FROM {view}")} == {"selection"}


def test_a_single_setting_needs_no_choice(tmp_path):
    store = SyntheticStore(tmp_path)
    for seed, value in enumerate((3.0, 5.0)):
        store.finish(store.plan("one", "SAC", "Pendulum-CA", seed), [value])
    (row,) = rows(store.write_studies(), "FROM tuned_per_environment")
    assert (row["num_settings"], row["mean"], row["standard_error"], row["num_tied"], row["runner_up"]) == (1, 4.0, 1.0, 0, None)
    assert row["on_edge"] == []
    runs = rows(tmp_path, 'SELECT "by", stage, seed, status FROM chosen_runs ORDER BY ALL')
    expected = [{"stage": "tune", "seed": seed, "status": "finished"} for seed in (0, 1)]
    assert runs == [{"by": by, **run} for by in ("across-environments", "per-environment") for run in expected]


def test_a_choice_is_shown_by_its_evaluation_runs_once_there_are_any(tmp_path):
    study = grid(SAC, "Pendulum-CA")
    store = random_store(tmp_path, study, 3, missing=0.0)
    choices = [choice for choice in chosen_by_code(study, store) if choice.by == "per-environment"]
    synthetic = SyntheticStore(tmp_path)
    synthetic.shards = 50
    for trial in expand(study):
        synthetic.plan_trial("study", trial)
    chosen = [(choice.agent, choice.environment, choice.hypers) for choice in choices]
    evaluation = evaluation_trials(dataclasses.replace(study, evaluate_seeds=(7, 8)), chosen)
    members = [synthetic.plan_trial("study", trial, "evaluate") for trial in evaluation]
    synthetic.write_studies()
    query = "SELECT DISTINCT stage, seed, status FROM chosen_runs WHERE \"by\" = 'per-environment' ORDER BY ALL"
    assert {row["stage"] for row in rows(tmp_path, query)} == {"tune"}
    synthetic.finish(members[0], [-5.0])
    shown = [{"stage": "evaluate", "seed": seed, "status": status} for seed, status in ((7, "finished"), (8, "missing"))]
    assert rows(tmp_path, query) == shown


@pytest.mark.parametrize("seed", range(3))
def test_normalized_scores_are_those_of_the_normalizers(tmp_path, seed):
    study = grid(GREEDY + SAC, *ENVIRONMENTS, tune=3)
    store = random_store(tmp_path, study, seed)
    trials = expand(study)
    scores, worst = gather_scores(store, trials, "episode_mean")
    measured = measure(study, trials, scores, worst)
    found = {
        (row["agent"], row["environment"], row["setting"], row["normalizer"]): row
        for row in rows(store.path, "FROM normalized_scores WHERE stage = 'tune'")
    }
    assert len(found) == 4 * len({(trial.agent, trial.environment, trial.setting) for trial in trials})
    constants = rows(store.path, "FROM normalizer_constants")
    for name in NORMALIZERS:
        rules = dataclasses.replace(study.select, normalizer=name)
        known = normalizer(dataclasses.replace(study, select=rules), trials, scores, measured)
        for place, setting in measured.items():
            values = known.normalize(place[1], setting.scores)
            row = found[*place, name]
            assert row["score"] == pytest.approx(math.fsum(values) / len(values), rel=1e-12, abs=1e-12)
            assert row["num_seeds"] == len(values)
        for row in constants:
            if row["normalizer"] == name:
                given = {key: row[key] for key in ("best_return", "low", "high") if row[key] is not None}
                assert given == pytest.approx(known.constants()[row["environment"]], rel=1e-14)
                assert row["source"] == "computed"


def test_normalized_scores_by_hand(tmp_path):
    """SAC has the runs 1, 3 and 5, 7 of two settings, GreedyAC 2 and 10 of one: means 2, 6, 6, and G* is 10."""
    store = SyntheticStore(tmp_path)
    values = {("SAC", "a"): (1, 3), ("SAC", "b"): (5, 7), ("GreedyAC", "c"): (2, 10)}
    for (agent, letter), returns in values.items():
        for seed, value in enumerate(returns):
            store.finish(store.plan("hand", agent, "Pendulum-CA", seed, setting=letter * 16), [value])
    store.finish(store.plan("hand", "SAC", "Pendulum-CA", 9, "evaluate", setting="a" * 16), [6.0])
    found = {
        (row["stage"], row["setting"][0], row["normalizer"]): row["score"]
        for row in rows(store.write_studies(), "FROM normalized_scores")
    }
    low = 2 + 0.1 * (6 - 2)  # the 5th percentile of 2, 6, 6; the 95th is 6
    expected = {
        ("tune", "a", "thesis"): (0.1 + 0.3) / 2,
        ("tune", "a", "minmax"): 0.0,
        ("tune", "a", "percentile"): (2 - low) / (6 - low),
        # below 1: none of SAC, none of GreedyAC; below 3: 1 of 4 and 1 of 2
        ("tune", "a", "cdf"): ((0 + 0) / 2 + (1 / 4 + 1 / 2) / 2) / 2,
        ("tune", "b", "thesis"): 0.6,
        ("tune", "b", "minmax"): 1.0,
        ("tune", "b", "cdf"): ((2 / 4 + 1 / 2) / 2 + (3 / 4 + 1 / 2) / 2) / 2,
        ("tune", "c", "cdf"): ((1 / 4 + 0) / 2 + (1 + 1 / 2) / 2) / 2,
        ("evaluate", "a", "thesis"): 0.6,
        ("evaluate", "a", "cdf"): (3 / 4 + 1 / 2) / 2,
    }
    assert {key: found[key] for key in expected} == pytest.approx(expected, rel=1e-15)
    (best,) = rows(tmp_path, "FROM normalizer_constants WHERE normalizer = 'thesis'")
    assert (best["best_return"], best["best_trial"]) == (10.0, digest("c" * 16, "Pendulum-CA", 1, "tune"))


def test_the_constants_of_a_frozen_selection_go_first(tmp_path):
    study = grid(SAC, "Pendulum-CA", select='normalizer = "minmax"')
    store = random_store(tmp_path, study, 2, missing=0.0)
    frozen = chosen_by_code(study, store)
    constants = {"Pendulum-CA": {"low": -100.0, "high": 100.0}}
    write_selection(store, "study", table("study", frozen, basis(study, expand(study)), constants))
    (row,) = rows(tmp_path, "FROM normalizer_constants WHERE normalizer = 'minmax'")
    assert (row["low"], row["high"], row["source"]) == (-100.0, 100.0, "selection")
    for row in rows(
        tmp_path,
        "SELECT score, mean FROM normalized_scores INNER JOIN setting_scores USING (study, stage, agent, environment, setting) "
        "WHERE normalizer = 'minmax'",
    ):
        expected = None if row["mean"] is None else (row["mean"] + 100) / 200
        assert row["score"] == pytest.approx(expected, rel=1e-12)


def test_the_scale_of_a_frozen_cdf_stays_when_more_tuning_runs_arrive(tmp_path):
    study = grid(GREEDY + SAC, *ENVIRONMENTS, tune=3, select='normalizer = "cdf"')
    store = random_store(tmp_path, study, 4, missing=0.3)
    frozen = chosen_by_code(study, store)
    scale = frozen.normalizer
    write_selection(store, "study", table("study", frozen, basis(study, expand(study)), scale.constants()))
    before = rows(tmp_path, "SELECT count(*) AS runs FROM run_scores WHERE score IS NOT NULL")
    synthetic = SyntheticStore(tmp_path, shards=50)
    there = {row["trial"] for row in rows(tmp_path, "SELECT trial FROM trials")}
    generator = np.random.default_rng(5)
    for trial in expand(study):
        if trial.id not in there:  # worse than all before, so that diverged runs count for less from now on
            member = synthetic.plan_trial("study", trial)
            synthetic.finish(member, [float(-generator.integers(30, 60))])
    query = "SELECT * FROM run_scores WHERE score IS NOT NULL"
    found = rows(tmp_path, query)
    assert len(found) > before[0]["runs"]
    places = {}
    for row in found:
        places.setdefault((row["agent"], row["environment"], row["setting"]), []).append(row["score"])
    shown = {
        (row["agent"], row["environment"], row["setting"]): row["score"]
        for row in rows(tmp_path, "FROM normalized_scores WHERE normalizer = 'cdf' AND score IS NOT NULL")
    }
    assert shown.keys() == places.keys()
    for place, scores in places.items():
        values = scale.normalize(place[1], scores)
        assert shown[place] == pytest.approx(math.fsum(values) / len(values), rel=1e-12, abs=1e-12), place


def test_where_a_normalizer_is_undefined_scores_are_null_and_nothing_is_chosen_by_it(tmp_path):
    store = SyntheticStore(tmp_path)
    for kappa in (0.1, 1.0):
        store.finish(store.plan("zero", "SAC", "Pendulum-CA", 0, actor_step_size_scale=kappa), [-4.0, 0.0])
    found = rows(store.write_studies(), "SELECT normalizer, score, num_seeds FROM normalized_scores")
    assert {row["normalizer"]: row["score"] for row in found} == {"thesis": None, "minmax": None, "percentile": None, "cdf": 0.0}
    assert {row["num_seeds"] for row in found} == {1}
    assert rows(tmp_path, "FROM tuned_across_environments") == []
    assert len(rows(tmp_path, "FROM tuned_per_environment")) == 1
    with pytest.raises(UndefinedNormalizerError):
        Normalizer.from_constants("thesis", {"Pendulum-CA": {"best_return": 0.0}}).normalize("Pendulum-CA", [-2.0])
