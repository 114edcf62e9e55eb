"""Importance as a table: shares of tiny grids that can be worked out, and grids that are refused."""

import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures.options import NoDataError, Options
from analysis.tables import importance

SCORES = {(0.1, 1.0): 7.0, (0.1, 0.1): -1.0, (0.01, 1.0): 1.0, (0.01, 0.1): -7.0}
"""Main effects ±3 of the step-size and ±4 of the entropy scale, and nothing else: variances 9 and 16."""


def study(path, scores=SCORES, luck=(-5, 5), missing=(), kappa=None):
    """SAC on Pendulum: (critic step-size, entropy scale) → mean score; `kappa`: step-size → actor step-size scale."""
    store = SyntheticStore(path / "store")
    for (step_size, scale), mean in scores.items():
        for seed, shift in enumerate(luck):
            more = {"actor_step_size_scale": kappa[step_size]} if kappa else {}
            trial = store.plan("demo", "SAC", "Pendulum-CA", seed, critic_step_size=step_size, entropy_scale=scale, **more)
            if (step_size, scale, seed) not in missing:
                store.finish(trial, [mean + shift])
    return store.write_studies()


def build(store, study="demo"):
    return importance.build(connect(store), study, Options())


def shares(table):
    return dict(zip(table.data["component"], table.data["share"], strict=True))


def test_an_additive_grid_has_the_shares_of_its_effects(tmp_path):
    table = build(study(tmp_path))
    expected = {"entropy_scale": 0.64, "critic_step_size": 0.36, "critic_step_size × entropy_scale": 0.0}
    assert shares(table) == pytest.approx(expected, abs=1e-9)
    assert table.data["variance"].tolist() == pytest.approx([16, 9, 0], abs=1e-9)
    assert table.data["share_low"].tolist() == pytest.approx([0.64, 0.36, 0], abs=1e-9)  # luck that all share is no noise
    assert table.data["order"].tolist() == [1, 1, 2]


def test_a_grid_of_an_interaction_alone_gives_it_everything(tmp_path):
    scores = {(0.1, 1.0): 1.0, (0.1, 0.1): -1.0, (0.01, 1.0): -1.0, (0.01, 0.1): 1.0}
    assert shares(build(study(tmp_path, scores)))["critic_step_size × entropy_scale"] == pytest.approx(1)


def test_intervals_of_few_seeds_carry_a_caution(tmp_path):
    caution = "2 seeds: intervals say little, and may lie beside their own estimate"
    assert caution in build(study(tmp_path)).notes
    assert not any("say little" in note for note in build(study(tmp_path / "more", luck=(-5, 5, 0, 1, -1))).notes)


def test_hyperparameters_that_were_swept_as_pairs_are_one_factor(tmp_path):
    scores = {(0.1, 1.0): 7.0, (0.1, 0.1): -1.0, (0.01, 1.0): 1.0, (0.01, 0.1): -7.0, (0.001, 1.0): 4.0, (0.001, 0.1): -4.0}
    table = build(study(tmp_path, scores, kappa={0.1: 1.0, 0.01: 1.0, 0.001: 10.0}))
    found = shares(table)
    assert found["critic_step_size & actor_step_size_scale"] == pytest.approx(6 / 22)  # effects 3, −3, 0: variance 6
    assert found["entropy_scale"] == pytest.approx(16 / 22)
    assert "SAC on Pendulum-CA: critic_step_size & actor_step_size_scale do not vary independently: one factor" in table.notes


def test_settings_that_lack_runs_are_named(tmp_path):
    with pytest.raises(NoDataError, match=r"1 of 4 settings lack runs.*critic_step_size = 0.01, entropy_scale = 0.1"):
        build(study(tmp_path, missing=[(0.01, 0.1, 0)]))


def test_a_grid_with_a_hole_is_refused_with_the_cell(tmp_path):
    scores = {place: mean for place, mean in SCORES.items() if place != (0.01, 0.1)}
    with pytest.raises(NoDataError, match=r"needs a full grid.*critic_step_size = 0.01, entropy_scale = 0.1"):
        build(study(tmp_path, scores))


def test_one_seed_is_refused(tmp_path):
    with pytest.raises(NoDataError, match="needs at least 2 runs, and there is 1 run"):
        build(study(tmp_path, luck=(0,)))


def test_settings_that_all_failed_have_no_shares(tmp_path):
    table = build(study(tmp_path, dict.fromkeys(SCORES, -100.0)))
    assert table.data["share"].isna().all()
    assert "SAC on Pendulum-CA: settings differ by no more than noise: shares are undefined" in table.notes


def test_groups_are_pairs_that_were_never_crossed():
    crossed = {"a": (1, 1, 2, 2), "b": (1, 2, 1, 2)}
    assert importance.crossed_groups(crossed) == ()
    assert importance.crossed_groups({**crossed, "c": (1, 1, 1, 2)}) == (("a", "b", "c"),)
    assert importance.crossed_groups({"a": (1, 1, 2, 2), "b": (1, 2, 1, 2), "c": (3, 3, 4, 4)}) == (("a", "c"),)


def test_the_shares_of_a_real_study_sum_up_to_one(real_store):
    table = build(real_store, "chapter-6")
    sums = table.data.dropna(subset=["share"]).groupby(["agent", "environment"])["share"].sum()
    assert len(sums) > 0
    assert sums.tolist() == pytest.approx([1] * len(sums))


def test_a_grid_of_three_that_lacks_a_pair_is_refused_and_not_made_one_of_two(tmp_path):
    store = SyntheticStore(tmp_path)
    cells = [(x, tau, kappa) for x in (0.1, 0.01, 0.001) for tau in (0.1, 1.0, 10.0) for kappa in (1.0, 2.0)]
    for x, tau, kappa in cells:
        for seed in (0, 1):
            if (x, tau) != (0.001, 10.0):
                hypers = {"critic_step_size": x, "entropy_scale": tau, "actor_step_size_scale": kappa}
                store.finish(store.plan("demo", "SAC", "Pendulum-CA", seed, **hypers), [x + tau + kappa + seed])
    with pytest.raises(NoDataError, match=r"needs a full grid.*critic_step_size = 0.001.*entropy_scale = 10"):
        build(store.write_studies())
