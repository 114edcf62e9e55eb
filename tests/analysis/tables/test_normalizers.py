"""The choice across environments under each normalizer: worked out by hand, floors and weights included."""

import pytest

from analysis import connect
from analysis.figures.options import NoDataError, Options
from analysis.tables import normalizers


def build(store, options=None, study="demo"):
    return normalizers.build(connect(store), study, options or Options())


def chosen(table, agent="GreedyAC"):
    rows = table.data[table.data["agent"] == agent]
    return {(row.normalizer, row.left_out): row.critic_step_size for row in rows.fillna({"left_out": "none"}).itertuples()}


def test_normalizers_choose_what_was_worked_out_by_hand(two_environments):
    found = chosen(build(two_environments()))
    # thesis: G* is 105 and −10, so N is (0, 0.48, 0.95) and (1, −1, −9): the first setting, because of Mountain Car
    assert found["thesis", "none"] == 0.1
    assert found["minmax", "none"] == 0.01
    assert {name for name, _ in found} == {"thesis", "minmax", "percentile", "cdf"}


def test_with_one_environment_left_out_the_other_decides(two_environments):
    found = chosen(build(two_environments()))
    for name in ("thesis", "minmax", "percentile"):
        assert found[name, "MountainCar-CA"] == 0.001
        assert found[name, "Pendulum-CA"] == 0.1


def test_ranks_are_relative_to_the_studys_own_choice(two_environments):
    rows = build(two_environments()).data.set_index(["agent", "normalizer", "left_out"]).loc["GreedyAC"]
    whole = rows[rows.index.get_level_values("left_out").isna()].droplevel("left_out")
    assert whole.loc["thesis", ["is_same", "rank_of_own_choice", "rank_correlation"]].tolist() == [True, 1, 1.0]
    assert whole.loc["minmax", ["is_same", "rank_of_own_choice"]].tolist() == [False, 2]
    assert rows.loc[("minmax", "Pendulum-CA"), "rank_correlation"] == pytest.approx(1.0)  # (1, 0.8, 0) as (0.5, −0.26, −4)
    assert rows.loc[("minmax", "MountainCar-CA"), "rank_correlation"] == pytest.approx(-1.0)


def test_floors_and_shares_of_the_spread_are_told_and_warned_of(two_environments):
    table = build(two_environments(), Options(normalizer="thesis", agents=("GreedyAC",)))
    rows = table.data.dropna(subset=["left_out"]).set_index("left_out")
    assert rows["floor"].to_dict() == pytest.approx({"MountainCar-CA": 2 - 110 / 10, "Pendulum-CA": -5 / 105})
    spread = {"MountainCar-CA": 10.0, "Pendulum-CA": 100 / 105}
    assert rows["spread_share"].to_dict() == pytest.approx({name: width / sum(spread.values()) for name, width in spread.items()})
    (warning,) = [note for note in table.notes if note.startswith("warning: GreedyAC: the thesis' normalizer weighs")]
    assert warning.endswith("unequally: MountainCar-CA has 91% of the spread, Pendulum-CA 9%")


def test_other_normalizers_are_not_warned_of(two_environments):
    assert not [note for note in build(two_environments(), Options(normalizer="cdf")).notes if note.startswith("warning")]


def test_the_choice_of_one_seed_is_shown_too(two_environments):
    assert chosen(build(two_environments(luck=(5,))))["minmax", "none"] == 0.01


def test_where_the_studys_normalizer_is_undefined_others_are_still_shown(two_environments):
    table = build(two_environments(luck=(-100, -100)), Options(agents=("GreedyAC",)))  # G* of Pendulum is 0
    assert set(table.data["normalizer"]) == {"minmax", "percentile", "cdf"}
    assert any(note.startswith("GreedyAC, thesis: Pendulum-CA: ") for note in table.notes)


def test_one_environment_has_no_choice_across(two_environments):
    with pytest.raises(NoDataError, match="needs several, and there is one"):
        build(two_environments(), Options(environments=("Pendulum-CA",)))


def test_a_real_study_has_a_row_for_each_normalizer_and_each_environment_left_out(real_store):
    table = build(real_store, study="chapter-6")
    environments = (
        connect(real_store).execute("SELECT COUNT(DISTINCT environment) FROM members WHERE study = 'chapter-6'").fetchone()
    )
    assert set(table.data.groupby(["agent", "normalizer"]).size()) == {1 + environments[0]}
    frozen = connect(real_store).execute(
        "SELECT DISTINCT agent, critic_step_size, actor_step_size_scale FROM selections "
        "WHERE study = 'chapter-6' AND \"by\" = 'across-environments'"
    )
    own = table.data[(table.data["normalizer"] == "thesis") & table.data["left_out"].isna()]
    shown = own[["agent", "critic_step_size", "actor_step_size_scale"]].itertuples(index=False, name=None)
    assert set(shown) == set(frozen.fetchall())
