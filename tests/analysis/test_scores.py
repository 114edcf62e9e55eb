"""Arrays of scores from a store, against numbers planned in it."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.scores import load, load_across, load_evaluated
from analysis.tuning_scale import find_normalizer
from sweep import schema
from sweep.messages import UserError
from sweep.normalizers import UndefinedNormalizerError

CA, DA = "Pendulum-CA", "Pendulum-DA"
SCALES = {CA: 100.0, DA: 50.0}


def returned(environment: str, x: float, tau: float | None, seed: int) -> float:
    """Return the one episode's return of a planned trial; the best are 25 (CA) and 16 (DA)."""
    return 10 * x + (tau or 0) + seed if environment == CA else 5 * x + seed


def study(path: Path, **changes: Any) -> SyntheticStore:
    """GreedyAC with x ∈ {1, 2} and τ ∈ {1, 4}, which discrete actions do not have; seeds 0 and 1; SAC is worse everywhere."""
    store = SyntheticStore(path)
    for environment in (CA, DA):
        for x in (1.0, 2.0):
            for tau in (1.0, 4.0) if environment == CA else (None,):
                for seed in (0, 1):
                    trial = store.plan("demo", "GreedyAC", environment, seed, critic_step_size=x, entropy_scale=tau)
                    if tau is None:
                        del trial["hypers"]["entropy_scale"]
                    if (environment, x, tau, seed) != changes.get("missing"):
                        store.finish(trial, [returned(environment, x, tau, seed)])
        trial = store.plan("demo", "SAC", environment, 0)
        store.finish(trial, [-SCALES[environment]])
    return store


def select(store: Path, rows: list[dict[str, Any]]) -> None:
    """Write a selection of the study."""
    texts = {"for_each": {}, "hypers": {}, "constants": {"best_return": 100.0}}
    filled = [
        {
            "study": "demo",
            "agent": "GreedyAC",
            "score": "episode_mean",
            "normalizer": "thesis",
            "diverged": "worst",
            "basis": "0" * 16,
        }
        | row
        | {name: json.dumps(row.get(name, value)) for name, value in texts.items()}
        for row in rows
    ]
    pq.write_table(pa.Table.from_pylist(filled, schema.SELECTIONS), store / "studies" / "demo" / "selections.parquet")


def test_settings_are_by_hash_with_what_varies_and_scores_by_seed(tmp_path):
    found = load(connect(study(tmp_path).write_studies()), "demo", "GreedyAC", CA)
    assert list(found.settings) == sorted(found.settings)
    assert set(found.hypers) == {"critic_step_size", "entropy_scale"}
    assert (found.seeds, found.score, found.stage, found.values.shape, found.complete) == (
        (0, 1),
        "episode_mean",
        "tune",
        (4, 2),
        True,
    )
    for x, tau, scores in zip(found.hypers["critic_step_size"], found.hypers["entropy_scale"], found.values, strict=True):
        assert scores.tolist() == [returned(CA, x, tau, 0), returned(CA, x, tau, 1)]


def test_what_is_missing_is_nan_and_can_be_left_out(tmp_path):
    found = load(connect(study(tmp_path, missing=(CA, 2.0, 4.0, 1)).write_studies()), "demo", "GreedyAC", CA)
    assert not found.complete
    assert np.isnan(found.values).sum() == 1
    kept = found.without_incomplete()
    assert (kept.values.shape, kept.complete) == ((3, 2), True)
    assert (2.0, 4.0) not in set(zip(kept.hypers["critic_step_size"], kept.hypers["entropy_scale"], strict=True))


def test_a_diverged_run_has_the_worst_return_and_a_failed_one_none(connection):
    found = load(connection, "demo", "GreedyAC", "Pendulum-CA")
    rows = dict(zip(found.settings, found.values.tolist(), strict=True))
    assert rows["b" * 16][:2] == [20, -100]
    assert all(map(math.isnan, [rows["b" * 16][2], *rows["c" * 16]]))
    assert rows["a" * 16] == [20, 30, 40]
    assert found.without_incomplete().settings == ("a" * 16, "f" * 16)
    assert load(connection, "demo", "GreedyAC", "Pendulum-CA", "final_mean", "evaluate").values.tolist() == [[60]]


def test_a_setting_without_the_hyperparameter_belongs_to_every_candidate_that_agrees(tmp_path):
    found = load_across(connect(study(tmp_path).write_studies()), "demo", "GreedyAC", normalizer="thesis")
    assert (found.environments, found.values.shape, found.frozen, found.num_left_out) == ((CA, DA), (2, 4, 2), False, 0)
    assert sorted(zip(found.hypers["critic_step_size"], found.hypers["entropy_scale"], strict=True)) == [
        (1, 1),
        (1, 4),
        (2, 1),
        (2, 4),
    ]
    assert len({here for here, _ in found.settings}) == 4
    assert len({here for _, here in found.settings}) == 2
    for h, (x, tau) in enumerate(zip(found.hypers["critic_step_size"], found.hypers["entropy_scale"], strict=True)):
        # N(p) = 1 − (G* − p) / |G*| = p / G* for a positive G*: 25 and 11
        assert found.values[0, h] == pytest.approx([returned(CA, x, tau, seed) / 25 for seed in (0, 1)])
        assert found.values[1, h] == pytest.approx([returned(DA, x, None, seed) / 11 for seed in (0, 1)])


def test_scales_are_of_the_runs_of_all_agents(tmp_path):
    connection = connect(study(tmp_path).write_studies())
    found = load_across(connection, "demo", "GreedyAC", normalizer="minmax", environments=[DA])
    assert found.environments == (DA,)
    assert found.hypers == {"critic_step_size": (1.0, 2.0)} or found.hypers == {"critic_step_size": (2.0, 1.0)}
    # the settings' means are 5.5, 10.5 and SAC's −50
    assert np.sort(found.values[0].mean(axis=1)) == pytest.approx([55.5 / 60.5, 1])
    shares = load_across(connection, "demo", "GreedyAC", normalizer="cdf", environments=[DA]).values[0]
    assert np.sort(shares.ravel()) == pytest.approx([0.5, 0.625, 0.75, 0.875])  # above SAC's one run, and 0 to 3 of four


def test_missing_runs_stay_missing_across_and_settings_without_them_make_the_scale(tmp_path):
    store = study(tmp_path, missing=(DA, 2.0, None, 1)).write_studies()
    found = load_across(connect(store), "demo", "GreedyAC", normalizer="cdf")
    lacking = np.isnan(found.values).any(axis=2)
    assert lacking.sum(axis=1).tolist() == [0, 2]
    assert not found.complete
    kept = found.without_incomplete()
    assert (kept.complete, set(kept.hypers)) == (True, {"entropy_scale"})
    assert np.nanmax(found.values[1]) == pytest.approx(1)  # 10 is above all runs of complete settings: 5, 6 and −50


def test_constants_of_a_selection_are_used_where_they_apply(tmp_path):
    store = study(tmp_path).write_studies()
    select(store, [{"by": "per-environment", "environment": place, "setting": "0" * 16} for place in (CA, DA)])
    connection = connect(store)
    frozen = load_across(connection, "demo", "GreedyAC")
    assert (frozen.normalizer, frozen.frozen) == ("thesis", True)
    assert np.nanmax(frozen.values[0]) == pytest.approx(25 / 100)
    assert load_across(connection, "demo", "GreedyAC", score="final_mean").frozen
    assert not load_across(connection, "demo", "GreedyAC", normalizer="cdf").frozen


def test_candidates_are_on_all_environments_and_the_others_are_counted(tmp_path):
    store = study(tmp_path)
    for seed in (0, 1):
        store.finish(store.plan("demo", "GreedyAC", CA, seed, critic_step_size=3.0, entropy_scale=1.0), [0])
    found = load_across(connect(store.write_studies()), "demo", "GreedyAC", normalizer="thesis")
    assert (found.values.shape[1], found.num_left_out) == (4, 1)
    assert 3.0 not in found.hypers["critic_step_size"]


def test_evaluation_scores_are_those_of_both_choices(tmp_path):
    store = study(tmp_path)
    planned = {}
    for environment, x, values in [(CA, 1.0, (10, 20)), (CA, 2.0, (60, 80)), (DA, 1.0, (40, 50)), (DA, 2.0, (7, 7))]:
        for seed, value in zip((5, 6), values, strict=True):
            planned[environment, x] = trial = store.plan("demo", "GreedyAC", environment, seed, "evaluate", critic_step_size=x)
            store.finish(trial, [value])
    path = store.write_studies()
    choices = [
        ("per-environment", CA, 2.0),
        ("across-environments", CA, 1.0),
        ("per-environment", DA, 1.0),
        ("across-environments", DA, 1.0),
    ]
    select(path, [{"by": by, "environment": place, "setting": planned[place, x]["setting"]} for by, place, x in choices])
    found = load_evaluated(connect(path), "demo", "GreedyAC")
    assert (found.environments, found.seeds) == ((CA, DA), (5, 6))
    assert found.tuned == pytest.approx(np.array([[0.6, 0.8], [0.4, 0.5]]))
    assert found.compromise == pytest.approx(np.array([[0.1, 0.2], [0.4, 0.5]]))
    select(path, [{"by": "per-environment", "environment": CA, "setting": "0" * 16}])
    with pytest.raises(UserError, match="a choice per environment and one across"):
        load_evaluated(connect(path), "demo", "GreedyAC")


def test_bad_requests_are_named(connection, tmp_path):
    for arguments, message in [
        (("dem", "GreedyAC", CA), 'study "dem" is not known; did you mean "demo"'),
        (("demo", "GredyAC", CA), 'agent "GredyAC" is not known; did you mean "GreedyAC"'),
        (("demo", "GreedyAC", "MountainCar-CA"), 'GreedyAC in study demo: environment "MountainCar-CA" is not known'),
        (("demo", "GreedyAC", CA, "episode_men"), 'score "episode_men" is not known; did you mean "episode_mean"'),
        (("demo", "GreedyAC", CA, "episode_mean", "tuning"), 'stage "tuning" is not known'),
        (("demo", "SAC", "MountainCar-CA"), "SAC on MountainCar-CA has no episode_mean of a tune run yet"),
    ]:
        with pytest.raises(UserError, match=message):
            load(connection, *arguments)
    with pytest.raises(UserError, match='normalizer "thesi" is not known; did you mean "thesis"'):
        load_across(connection, "demo", "GreedyAC", normalizer="thesi")
    with pytest.raises(UserError, match="no setting on MountainCar-CA has all of its tuning runs yet"):
        load_across(connection, "demo", "SAC", normalizer="cdf", environments=["MountainCar-CA"])
    with pytest.raises(UserError, match='study "demo" has no evaluate trial'):
        load_evaluated(connect(study(tmp_path / "tuned").write_studies()), "demo", "GreedyAC")
    store = SyntheticStore(tmp_path / "zero")
    store.finish(store.plan("demo", "SAC", CA, 0), [0])
    with pytest.raises(UndefinedNormalizerError, match=r"G\*, the highest return of an episode, is 0"):
        load_across(connect(store.write_studies()), "demo", "SAC", normalizer="thesis")


def test_a_diverged_run_is_as_if_not_planned_for_a_study_that_drops_it(tmp_path):
    store = SyntheticStore(tmp_path)
    for x, scores in ((1.0, (4, math.nan)), (2.0, (5, 7)), (3.0, (math.nan, math.nan))):
        for seed, score in enumerate(scores):
            store.finish(store.plan("demo", "SAC", CA, seed, critic_step_size=x), [score])
    path = store.write_studies()
    (path / "studies" / "demo" / "grid.toml").write_text('[select]\ndiverged = "drop"\n')
    connection = connect(path)
    kept = load(connection, "demo", "SAC", CA).without_incomplete()
    assert dict(zip(kept.hypers["critic_step_size"], kept.means, strict=True)) == {1.0: 4, 2.0: 6}
    assert (kept.complete, int(kept.dropped.sum())) == (True, 1)
    scale, _, _ = find_normalizer(connection, "demo", "episode_mean", "minmax", [CA])
    assert scale.normalize(CA, [4, 6]) == pytest.approx([0, 1])


@pytest.mark.parametrize(("diverged", "complete"), [("drop", [False, False, True, True]), ("worst", [True, True, True, True])])
def test_a_setting_all_of_whose_runs_are_dropped_is_not_complete(tmp_path, diverged, complete):
    store = SyntheticStore(tmp_path)
    for step_size, last in ((0.1, math.nan), (0.2, -2.0)):
        for seed in range(2):
            store.finish(store.plan("demo", "SAC", "Pendulum-CA", seed, critic_step_size=step_size), [-1.0, last])
    path = store.write_studies()
    (path / "studies" / "demo" / "grid.toml").write_text(f'[select]\ndiverged = "{diverged}"\n')
    sql = "SELECT is_complete FROM run_scores INNER JOIN trials USING (trial) ORDER BY critic_step_size, trials.seed"
    assert [row[0] for row in connect(path).execute(sql).fetchall()] == complete
