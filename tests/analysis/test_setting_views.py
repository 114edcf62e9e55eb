"""Hyperparameters in long form, slices, worst and best returns; and what views say of runs that went wrong."""

import math

import pyarrow.parquet as pq
import pytest
from synthetic_store import STEPS, SyntheticStore

from agents.registry import ALGORITHMS
from analysis import connect
from analysis.database import view_sources
from sweep.grid import parse
from sweep.messages import UserError


def query(path, sql):
    connection = connect(path)
    try:
        return connection.sql(sql).fetchall()
    finally:
        connection.close()


def test_hyperparameters_are_texts_and_numbers_and_say_whether_they_are_swept(tmp_path):
    store = SyntheticStore(tmp_path)
    for x in (1e-3, 1e-5):
        store.plan("s", "GreedyAC", "Pendulum-CA", 0, critic_step_size=x, entropy_scale=0.5, depth="deep", fast=True)
    store.plan("s", "SAC", "Pendulum-CA", 0, critic_step_size=7.0)
    names = "('critic_step_size', 'hidden_layers', 'depth', 'fast', 'entropy_scale', 'batch_size')"
    found = query(
        store.write_studies(),
        f"SELECT DISTINCT hyperparameter, value, number, is_swept FROM hyperparameters WHERE agent = 'GreedyAC' "
        f"AND hyperparameter IN {names} ORDER BY ALL",
    )
    assert found == [
        ("batch_size", "32", 32.0, False),
        ("critic_step_size", "0.001", 1e-3, True),
        ("critic_step_size", "1e-05", 1e-5, True),
        ("depth", "deep", None, False),
        ("entropy_scale", "0.5", 0.5, False),
        ("fast", "true", None, False),
        ("hidden_layers", "[64, 64]", None, False),
    ]
    assert query(tmp_path, "SELECT DISTINCT is_swept FROM hyperparameters WHERE agent = 'SAC'") == [(False,)]
    # what does not apply has no row
    assert query(tmp_path, "SELECT * FROM hyperparameters WHERE agent = 'SAC' AND hyperparameter = 'depth'") == []


def sliced(tmp_path):
    """Means by critic step-size (rows) and entropy scale (columns); the best is 9, in the middle row."""
    means = {(0.1, 1.0): 1, (0.1, 2.0): 8, (0.01, 1.0): 9, (0.01, 2.0): 2, (0.001, 2.0): 5}
    store = SyntheticStore(tmp_path)
    for (x, tau), mean in means.items():
        for seed in range(2):
            member = store.plan("s", "SAC", "Pendulum-CA", seed, critic_step_size=x, entropy_scale=tau, setting=f"{mean}" * 16)
            store.finish(member, [mean - 1 + 2 * seed])
    return store.write_studies()


def test_a_slice_goes_through_the_best_setting_and_beside_it_lies_the_best_over_all_others(tmp_path):
    found = query(
        sliced(tmp_path),
        "SELECT hyperparameter, number, at_best, at_best_setting[1], best_over_others, best_over_others_setting[1], "
        "best_over_others_num_seeds, num_settings FROM slices ORDER BY ALL",
    )
    assert found == [
        ("critic_step_size", 0.001, None, None, 5.0, "5", 2, 1),
        ("critic_step_size", 0.01, 9.0, "9", 9.0, "9", 2, 2),
        ("critic_step_size", 0.1, 1.0, "1", 8.0, "8", 2, 2),
        ("entropy_scale", 1.0, 9.0, "9", 9.0, "9", 2, 2),
        ("entropy_scale", 2.0, 2.0, "2", 8.0, "8", 2, 3),
    ]


def derived(tmp_path, grid=None):
    """Figure 7.2's pattern: the fraction is 3 ÷ samples, and changes along with them."""
    means = {(10, 0.1): 1, (10, 1.0): 8, (30, 0.1): 9, (30, 1.0): 2}
    store = SyntheticStore(tmp_path)
    for (samples, tau), mean in means.items():
        hypers = {"num_action_samples": samples, "elite_fraction": 3 / samples, "entropy_scale": tau}
        store.finish(store.plan("s", "GreedyAC", "Pendulum-CA", 0, setting=f"{mean}" * 16, **hypers), [mean])
    path = store.write_studies()
    if grid:
        (path / "studies" / "s" / "grid.toml").write_text(grid)
    return query(path, "SELECT hyperparameter, number, at_best FROM slices ORDER BY ALL")


def test_what_is_a_function_of_the_sliced_hyperparameter_changes_along_with_it(tmp_path):
    samples = [("num_action_samples", 10.0, 1.0), ("num_action_samples", 30.0, 9.0)]
    scales = [("entropy_scale", 0.1, 9.0), ("entropy_scale", 1.0, 2.0)]
    fractions = [("elite_fraction", 0.1, 9.0), ("elite_fraction", 0.3, 1.0)]
    assert derived(tmp_path / "zipped") == [*fractions, *scales, *samples]
    grid = '[[agent]]\nname = "GreedyAC"\nderive = { elite_fraction = "3 / num_action_samples" }\n'
    assert derived(tmp_path / "derived", grid) == [*scales, *samples]
    swept = query(tmp_path / "derived", "SELECT DISTINCT hyperparameter FROM hyperparameters WHERE is_swept ORDER BY 1")
    assert swept == [("elite_fraction",), ("entropy_scale",), ("num_action_samples",)]


def test_a_hyperparameter_that_some_settings_lack_is_no_function_of_another(tmp_path):
    store = SyntheticStore(tmp_path)
    for mean, (x, depth) in enumerate([(0.1, {"depth": 1}), (0.01, {"depth": 2}), (0.01, {})]):
        store.finish(store.plan("s", "SAC", "Pendulum-CA", 0, critic_step_size=x, setting=f"{mean}" * 16, **depth), [mean])
    found = query(
        store.write_studies(), "SELECT number, at_best FROM slices WHERE hyperparameter = 'critic_step_size' ORDER BY 1"
    )
    assert found == [(0.01, 2.0), (0.1, None)]


def test_a_hyperparameter_named_like_a_column_of_results_is_left_out_beside_them(tmp_path):
    store = SyntheticStore(tmp_path)
    names = {
        "mean": 7.0,
        "Score": 7.0,
        "num_settings": 7.0,
        "on_edge": 7.0,
        "is_frozen": 7.0,
        "episode_mean_low": 7.0,
        "plain": 7.0,
    }
    for seed in range(2):
        store.finish(store.plan("s", "SAC", "Pendulum-CA", seed, **names), [-4.0])
    store.write_studies()
    for view in ("tuned_per_environment", "tuned_across_environments"):
        assert query(tmp_path, f"SELECT mean, score, num_settings, plain FROM {view}") == [(-4.0, "episode_mean", 1, 7.0)]
    assert query(tmp_path, "SELECT episode_mean, episode_mean_low, plain FROM settings") == [(-4.0, -4.0, 7.0)]
    connection = connect(tmp_path)
    for view in view_sources():
        columns = [name.lower() for name in connection.sql(f"FROM {view}").limit(1).to_arrow_table().column_names]
        assert len(set(columns)) == len(columns), view
    assert set(names) <= {row[0] for row in query(tmp_path, "SELECT hyperparameter FROM hyperparameters")}


@pytest.mark.parametrize("view", ["settings", "tuned_per_environment", "tuned_across_environments"])
def test_no_hyperparameter_takes_the_name_of_a_column_of_results(tmp_path, view):
    connection = connect(SyntheticStore(tmp_path).write_studies())
    columns = {row[0] for row in connection.execute(f"DESCRIBE {view}").fetchall()}
    results = columns - {name for algorithm in ALGORITHMS.values() for name in algorithm.hypers.table}
    assert len(results) > 15
    head = (
        '[study]\nname = "x"\nenvironments = ["Pendulum-CA"]\nsteps = 1\n[seeds]\ntune = 1\n[[agent]]\nname = "textwrap:fill"\n'
    )
    for name in results:
        with pytest.raises(UserError, match=rf"agent\[1\]\.fixed\.{name}: is the name of a column"):
            parse(head + f"fixed = {{ {name} = 1 }}\n", "grid.toml")
    connection.close()


def test_settings_on_the_edge_have_the_lowest_or_highest_of_three_values(tmp_path):
    found = query(sliced(tmp_path), "SELECT setting[1], on_edge FROM setting_edges ORDER BY 1")
    edge = ["critic_step_size"]  # there are only two entropy scales
    assert found == [("1", edge), ("2", []), ("5", edge), ("8", edge), ("9", [])]


def test_the_worst_return_is_that_of_the_studys_own_tuning_trials(tmp_path):
    store = SyntheticStore(tmp_path)
    store.finish(store.plan("a", "SAC", "Pendulum-CA", 0), [-5.0, -30.0, -99.0], ["truncated", "truncated", "budget"])
    store.finish(store.plan("a", "SAC", "Pendulum-CA", 1, "evaluate"), [-70.0])
    store.finish(store.plan("b", "SAC", "Pendulum-CA", 2), [-90.0])
    assert query(store.write_studies(), "FROM worst_returns ORDER BY study") == [
        ("a", "Pendulum-CA", -30.0),
        ("b", "Pendulum-CA", -90.0),
    ]


def without_worst_episode(path, shard):
    file = path / "shards" / shard / "trials.parquet"
    table = pq.read_table(file)
    pq.write_table(table.drop_columns(["worst_episode"]), file, write_page_checksum=True, store_schema=False)


def test_where_the_worst_episode_is_not_known_it_is_looked_up(tmp_path):
    store = SyntheticStore(tmp_path)
    for seed, low in enumerate((-30.0, -60.0)):
        store.finish(store.plan("a", "SAC", "Pendulum-CA", seed), [-5.0, low])
    store.write_studies()
    without_worst_episode(tmp_path, "shard-0001")
    assert query(tmp_path, "SELECT worst_episode FROM trials ORDER BY seed") == [(-30.0,), (None,)]
    assert query(tmp_path, "FROM worst_returns") == [("a", "Pendulum-CA", -60.0)]


def test_every_view_answers_where_all_runs_diverged_or_returns_are_no_numbers(tmp_path):
    store = SyntheticStore(tmp_path)
    nan, inf = math.nan, math.inf
    for seed, returns in enumerate(([nan, nan], [nan], [inf], [-inf])):
        for agent in ("SAC", "GreedyAC"):
            store.finish(store.plan("bad", agent, "Pendulum-CA", seed), returns, evaluations=[(1, nan)])
    store.finish(store.plan("bad", "SAC", "MountainCar-DA", 0), [nan], evaluations=[(1, -inf)])
    store.finish(store.plan("worse", "SAC", "MountainCar-DA", 1), [-9.0], ["budget"])
    connection = connect(store.write_studies())
    for view in view_sources().keys() - {"study_rules"}:
        table = connection.sql(f"FROM {view}").to_arrow_table()
        for name, column in zip(table.column_names, table.columns, strict=True):
            if name in ("mean", "score", "episode_mean", "best_mean", "standard_error", "low", "high", "best_return"):
                assert column.null_count == len(column), (view, name)
    assert connection.execute(
        "SELECT num_seeds, num_diverged FROM settings WHERE environment LIKE 'M%' ORDER BY ALL"
    ).fetchall() == [
        (0, 0),
        (0, 1),
    ]
    connection.close()


@pytest.fixture(scope="module")
def connections(tmp_path_factory):
    """Connections to the stores of two studies, and to one with both."""
    stores = {name: SyntheticStore(tmp_path_factory.mktemp(name)) for name in ("a", "b", "both")}
    for study, low, first_seed in (("a", -50.0, 0), ("b", -80.0, 5)):
        for name in (study, "both"):
            runs = []
            for seed in (first_seed, first_seed + 1):
                for x in (0.1, 0.01, 0.001):
                    member = stores[name].plan(study, "SAC", "Pendulum-CA", seed, critic_step_size=x, setting=f"{x:.0e}"[-1] * 16)
                    runs.append((member, [low - x, -20.0 * x - seed], (), (), [(STEPS, low)]))
            stores[name].finish_together(runs)
    opened = {name: connect(store.write_studies()) for name, store in stores.items()}
    yield opened
    for connection in opened.values():
        connection.close()


@pytest.mark.parametrize("view", sorted(view_sources().keys() - {"best_returns", "completed_episodes", "student_quantiles"}))
def test_a_view_of_several_studies_has_the_rows_of_each_alone(connections, view):
    columns = "study, step, mean" if view == "learning_curves" else "*"
    rows = {name: connection.execute(f"SELECT {columns} FROM {view}").fetchall() for name, connection in connections.items()}
    assert sorted(rows["both"], key=str) == sorted(rows["a"] + rows["b"], key=str)
    assert rows["a"] and rows["b"]
