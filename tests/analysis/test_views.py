"""The views against numbers worked out by hand from `conftest.build`."""

import math
from typing import Any

import duckdb
import pytest
from synthetic_store import SyntheticStore

from analysis import connect


def rows(connection: duckdb.DuckDBPyConnection, sql: str) -> list[tuple[Any, ...]]:
    return connection.execute(sql).fetchall()


def setting(connection: duckdb.DuckDBPyConnection, digit: str, columns: str) -> tuple[Any, ...]:
    (row,) = rows(connection, f"SELECT {columns} FROM settings WHERE setting = repeat('{digit}', 16) AND stage = 'tune'")
    return row


def test_a_settings_mean_is_over_seeds_of_the_mean_over_completed_episodes(connection):
    assert setting(connection, "a", "num_seeds, num_planned, num_diverged, episode_mean") == (3, 3, 0, 30.0)


def test_the_interval_is_students_t_with_the_sample_standard_deviation(connection):
    error, low, high = setting(connection, "a", "episode_mean_standard_error, episode_mean_low, episode_mean_high")
    assert error == pytest.approx(10 / math.sqrt(3))  # 20, 30, 40: sample standard deviation 10
    assert (low, high) == pytest.approx((30 - 4.3027 * 10 / math.sqrt(3), 30 + 4.3027 * 10 / math.sqrt(3)))


def test_each_score_has_its_own_interval(connection):
    for score in ("step_mean", "final_mean"):
        names = f"{score}, {score}_standard_error, {score}_low, {score}_high"
        mean, error, low, high = setting(connection, "f", names)  # 0, 0, 3: mean 1, deviation √3
        assert (mean, error, low, high) == pytest.approx((1, 1, 1 - 4.3027, 1 + 4.3027))


def test_one_seed_has_a_mean_and_no_interval(connection):
    columns = "num_seeds, episode_mean, episode_mean_standard_error, episode_mean_low, episode_mean_high"
    assert setting(connection, "d", columns) == (1, 50.0, None, None, None)


def test_a_diverged_seed_counts_as_the_worst_completed_return_of_the_environment(connection):
    assert setting(connection, "b", "num_seeds, num_planned, num_diverged, episode_mean") == (2, 3, 1, (20 - 100) / 2)


def test_a_setting_without_any_finished_seed_has_a_row_of_nulls(connection):
    assert setting(connection, "c", "num_seeds, num_planned, episode_mean, step_mean_low") == (0, 3, None, None)


def test_failed_trials_and_those_that_completed_no_episode_are_no_seeds(connection):
    assert setting(connection, "9", "num_seeds, num_planned, num_diverged, episode_mean") == (1, 3, 0, 60.0)


def test_a_diverged_seed_without_a_worst_return_to_count_as_is_no_seed(connection):
    assert setting(connection, "8", "num_seeds, num_planned, num_diverged, episode_mean") == (0, 3, 1, None)


def test_settings_carry_the_hyperparameters_of_their_own_algorithm(connection):
    names = "critic_step_size, actor_step_size_scale, hidden_layers, num_action_samples"
    assert setting(connection, "b", names) == (1e-3, 0.1, [64, 64], 30)
    assert setting(connection, "9", names) == (1e-3, 1.0, [64, 64], None)


def test_stages_are_kept_apart(connection):
    found = rows(connection, "SELECT stage, num_planned, episode_mean FROM settings WHERE stage = 'evaluate'")
    assert found == [("evaluate", 1, 60.0)]


def test_the_best_return_is_of_a_completed_episode_and_ties_go_to_the_lowest_trial(connection):
    reached = rows(connection, "SELECT trial FROM episodes WHERE episodic_return = 60 AND ending = 'truncated'")
    assert len(reached) == 3
    found = rows(connection, "SELECT environment, best_return, trial, episode FROM best_returns")
    assert found == [("Pendulum-CA", 60.0, min(reached)[0], 0)]


def test_the_worst_return_leaves_out_budget_cut_and_diverged_episodes(connection):
    assert rows(connection, "FROM worst_returns") == [("demo", "Pendulum-CA", -100.0)]


def test_progress_counts_each_planned_trial_once(connection):
    found = rows(connection, "FROM study_progress ORDER BY stage DESC, agent, environment")
    assert found == [
        ("demo", "tune", "GreedyAC", "Pendulum-CA", 18, 10, 1, 0, 7),
        ("demo", "tune", "SAC", "MountainCar-CA", 3, 0, 1, 0, 2),
        ("demo", "tune", "SAC", "Pendulum-CA", 3, 2, 0, 1, 0),
        ("demo", "evaluate", "GreedyAC", "Pendulum-CA", 1, 1, 0, 0, 0),
    ]


def test_a_line_takes_the_best_setting_and_of_equals_the_lowest_hash(connection):
    found = rows(
        connection,
        "SELECT critic_step_size, entropy_scale, best_mean, setting[1], num_seeds, min_num_seeds, num_settings, "
        "num_settings_planned FROM sensitivity_lines WHERE agent = 'GreedyAC' ORDER BY ALL",
    )
    assert found == [
        (1e-3, 0.1, 30.0, "a", 3, 2, 2, 2),
        (1e-2, 0.1, 50.0, "d", 1, 1, 2, 2),  # d and e both have mean 50
        (1e-2, 1.0, 1.0, "f", 3, 3, 1, 1),
    ]


def test_lines_without_data_are_absent_rather_than_null(connection):
    assert rows(connection, "SELECT count(*) FROM sensitivity_lines WHERE environment = 'MountainCar-CA'") == [(0,)]


def test_a_region_lies_between_its_lowest_and_highest_line(connection):
    found = rows(
        connection,
        "SELECT critic_step_size, low, high, num_lines, lines FROM sensitivity_regions "
        "WHERE agent = 'GreedyAC' ORDER BY critic_step_size",
    )
    line_a = {"entropy_scale": 0.1, "best_mean": 30.0, "setting": "a" * 16, "num_seeds": 3}
    line_d = {"entropy_scale": 0.1, "best_mean": 50.0, "setting": "d" * 16, "num_seeds": 1}
    line_f = {"entropy_scale": 1.0, "best_mean": 1.0, "setting": "f" * 16, "num_seeds": 3}
    assert found == [(1e-3, 30.0, 30.0, 1, [line_a]), (1e-2, 1.0, 50.0, 2, [line_d, line_f])]


def test_the_quantiles_are_students(connection):
    found = rows(connection, "SELECT degrees_of_freedom, quantile FROM student_quantiles ORDER BY ALL")
    assert [row[0] for row in found[:30]] == list(range(1, 31))
    for degrees, quantile in found:
        scale = math.exp(math.lgamma((degrees + 1) / 2) - math.lgamma(degrees / 2)) / math.sqrt(degrees * math.pi)
        width = float(quantile) / 2_000  # the density from 0 to the quantile, by Simpson's rule, is 0.475
        density = [scale * (1 + (width * i) ** 2 / degrees) ** (-(degrees + 1) / 2) for i in range(2_001)]
        area = width / 3 * (density[0] + 4 * sum(density[1::2]) + 2 * sum(density[2:-1:2]) + density[-1])
        assert area == pytest.approx(0.475, abs=6e-5 * density[-1])


def test_settings_without_a_seed_are_planned_and_not_considered(tmp_path):
    store = SyntheticStore(tmp_path)
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 0, actor_step_size_scale=0.1), [5.0])
    store.plan("demo", "SAC", "Pendulum-CA", 0, actor_step_size_scale=1.0)
    found = rows(
        connect(store.write_studies()),
        "SELECT num_seeds, min_num_seeds, num_settings, num_settings_planned FROM sensitivity_lines",
    )
    assert found == [(1, 1, 1, 2)]
