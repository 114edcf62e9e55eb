"""Table 6.1: the highest return of one episode, and who reached it."""

import math

import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query
from analysis.tables import best_returns
from analysis.tables.table import Table


def built(store: SyntheticStore, **options: object) -> Table:
    return best_returns.build(connect(store.write_studies()), "demo", Options(**options))


@pytest.fixture
def planted(tmp_path):
    """G* is 930 on Pendulum-CA, by SAC on seed 1, and -65 on MountainCar-CA, by GreedyAC on seed 0."""
    store = SyntheticStore(tmp_path)
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 0), [900.0, 999.0], ["truncated", "budget"])
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 1), [-10.0, 930.0])
    store.finish(store.plan("demo", "GreedyAC", "Pendulum-CA", 0), [929.0])
    store.finish(store.plan("demo", "GreedyAC", "MountainCar-CA", 0), [-65.0, math.nan])
    store.finish(store.plan("demo", "SAC", "MountainCar-CA", 0), [-1000.0, -3.0], ["truncated", "budget"])
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 7, "evaluate"), [940.0])
    store.finish(store.plan("other", "SAC", "Pendulum-CA", 8), [950.0])
    return store


def test_the_highest_completed_episode_of_the_studys_tuning_runs_and_its_run_are_listed(planted):
    table = built(planted)
    columns = ["environment", "best_return", "agent", "seed"]
    assert table.data[columns].to_numpy().tolist() == [["MountainCar-CA", -65, "GreedyAC", 0], ["Pendulum-CA", 930, "SAC", 1]]
    assert table.data["trial"][1] == planted.members["demo"][1]["trial"]
    assert table.notes == ["study demo: over 5 tuning runs of all agents and settings"]
    assert "Pendulum-CA" in table.text()
    assert built(planted, environments=("Pend*",)).data["environment"].to_list() == ["Pendulum-CA"]


def test_the_query_gives_the_table(planted):
    table = built(planted)
    rows = run_query(planted.path, table.sql).to_pylist()
    assert [row["best_return"] for row in rows] == table.data["best_return"].to_list()


def test_a_highest_return_of_zero_is_pointed_out(tmp_path):
    store = SyntheticStore(tmp_path)
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 0), [0.0, -5.0])
    table = built(store)
    assert table.data["best_return"].to_list() == [0]
    assert "Pendulum-CA: G* is 0, and the thesis' normalizer, which divides by |G*|, is undefined there" in table.notes[1]


def test_missing_runs_and_environments_without_an_episode_are_said(tmp_path):
    store = SyntheticStore(tmp_path)
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 0), [3.0])
    store.plan("demo", "SAC", "Pendulum-CA", 1)
    store.finish(store.plan("demo", "SAC", "Acrobot-CA", 0), [math.nan])
    table = built(store)
    assert "Pendulum-CA: 1 of 2 tuning runs: G* may still rise" in table.notes
    assert "Acrobot-CA: no completed episode yet" in table.notes
    with pytest.raises(NoDataError, match="no completed episode of a tuning run yet"):
        built(store, environments=("Acrobot-CA",))


def test_studies_that_tune_go_before_those_with_one_setting(real_store, empty_store):
    assert best_returns.studies(connect(real_store), Options())[-1] != "chapter-6"
    assert best_returns.studies(connect(empty_store), Options()) == []


def test_a_trained_study_has_the_highest_of_its_episodes(real_store):
    table = best_returns.build(connect(real_store), "chapter-6", Options())
    known = connect(real_store).execute(
        """
        SELECT environment, max(episodic_return)
        FROM members INNER JOIN episodes USING (trial)
        WHERE study = 'chapter-6' AND stage = 'tune' AND ending <> 'budget'
        GROUP BY environment
        ORDER BY environment
        """
    )
    assert table.data[["environment", "best_return"]].to_numpy().tolist() == [list(row) for row in known.fetchall()]
