"""Scores of a run by hand, and the tables that a shard becomes."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

from agents.hypers import SACHypers
from sweep.provenance import Provenance
from sweep.tables import members_table, run_scores, shard_tables
from sweep.trials import Trial

TERMINATED, TRUNCATED, BUDGET = 0, 1, 2
PROVENANCE = Provenance("cpu", "torch", "host", "abc", "{}")


def records(*agents, diverged_at=None):
    """Each agent is a list of (length, return, ending)."""
    columns = {name: [] for name in ("agent", "episode", "first_step", "length", "episodic_return", "ending")}
    for agent, episodes in enumerate(agents):
        first = 1
        for number, (length, episodic_return, ending) in enumerate(episodes):
            for name, value in zip(columns, (agent, number, first, length, episodic_return, ending), strict=True):
                columns[name].append(value)
            first += length
    types = {"episodic_return": np.float32, "ending": np.uint8}
    arrays = {name: np.array(values, types.get(name, np.int32)) for name, values in columns.items()}
    steps = sum(length for length, _, _ in agents[0])
    return SimpleNamespace(steps=steps, diverged_at=np.array(diverged_at or [0] * len(agents)), **arrays)


def test_the_episode_mean_is_unweighted_and_the_step_mean_is_weighted_by_length():
    scores = run_scores(records([(10, 1, TERMINATED), (30, 5, TRUNCATED)]), 0)
    assert scores["episode_mean"] == 3
    assert scores["step_mean"] == (10 * 1 + 30 * 5) / 40
    assert (scores["episodes"], scores["status"], scores["best_episode"], scores["worst_episode"]) == (2, "finished", 5, 1)


def test_the_final_mean_covers_the_last_tenth_of_the_steps():
    scores = run_scores(records([(85, 0, TERMINATED), (13, 10, TERMINATED), (2, 100, TERMINATED)]), 0)
    assert scores["final_mean"] == pytest.approx((8 * 10 + 2 * 100) / 10)


def test_the_budget_cut_last_episode_enters_no_score():
    scores = run_scores(records([(50, -50, TRUNCATED), (50, -50, TRUNCATED), (3, -300, BUDGET)]), 0)
    assert scores["episode_mean"] == scores["step_mean"] == scores["final_mean"] == scores["best_episode"] == -50
    assert scores["worst_episode"] == -50
    assert scores["episodes"] == 3


def test_a_run_without_a_completed_episode_has_no_score():
    scores = run_scores(records([(7, -7, BUDGET)]), 0)
    assert (
        scores["episode_mean"]
        is scores["step_mean"]
        is scores["final_mean"]
        is scores["best_episode"]
        is scores["worst_episode"]
        is None
    )
    assert scores["status"] == "finished"


def test_a_diverged_run_is_marked_and_keeps_its_best_and_worst_episode_only():
    scores = run_scores(records([(5, 2, TERMINATED), (5, np.nan, TERMINATED)], diverged_at=[7]), 0)
    assert (scores["status"], scores["diverged_at"]) == ("diverged", 7)
    assert (scores["best_episode"], scores["worst_episode"]) == (2, 2)
    assert scores["episode_mean"] is scores["step_mean"] is scores["final_mean"] is None


def test_a_shard_becomes_one_row_a_trial_an_episode_and_a_step():
    trials = [Trial("SAC", "Pendulum-CA", SACHypers(), seed, 5, 1000, 0.99) for seed in (0, 1)]
    tables = shard_tables(trials, records([(2, 1, 0), (3, 2, 2)], [(5, 3, 1)]), 4.0, PROVENANCE)
    assert tables.trials["trial"].to_pylist() == [trial.id for trial in trials]
    assert tables.trials["wall_seconds"].to_pylist() == [2.0, 2.0]
    assert tables.trials["hidden_layers"].to_pylist() == [[64, 64]] * 2
    assert tables.episodes["ending"].to_pylist() == ["terminated", "budget", "truncated"]
    (steps,) = tables.steps_in_blocks(10)
    assert steps["step"].to_pylist() == [1, 2, 3, 4, 5] * 2
    assert steps["episodic_return"].to_pylist() == [1, 1, 2, 2, 2, 3, 3, 3, 3, 3]
    assert steps["trial"].to_pylist() == [trials[0].id] * 5 + [trials[1].id] * 5
    rest = tables.without({trials[0].id})
    assert rest.trials["seed"].to_pylist() == [1]
    assert rest.episodes.num_rows == 1
    (steps,) = rest.steps_in_blocks(10)
    assert steps["trial"].to_pylist() == [trials[1].id] * 5


@pytest.mark.parametrize("rows", range(1, 14))
def test_steps_are_the_same_rows_whatever_the_size_of_the_blocks(rows):
    trials = [Trial("SAC", "Pendulum-CA", SACHypers(), seed, 4, 1000, 0.99) for seed in (0, 1, 2)]
    tables = shard_tables(trials, records([(1, 1, 0), (3, 2, 0)], [(4, 3, 1)], [(2, 4, 0), (2, 5, 2)]), 4.0, PROVENANCE)
    for gone, returns in (((), [1, 2, 2, 2, 3, 3, 3, 3, 4, 4, 5, 5]), ((1,), [1, 2, 2, 2, 4, 4, 5, 5]), ((0, 1, 2), [])):
        left = tables.without({trials[seed].id for seed in gone})
        blocks = list(left.steps_in_blocks(rows))
        full, rest = divmod(len(returns), rows)
        assert [block.num_rows for block in blocks] == [rows] * full + [rest] * (rest > 0)
        kept = [trial.id for seed, trial in enumerate(trials) if seed not in gone]
        assert [(row["trial"], row["step"], row["episodic_return"]) for block in blocks for row in block.to_pylist()] == list(
            zip(np.repeat(kept, 4), [1, 2, 3, 4] * len(kept), returns, strict=True)
        )


def test_a_block_of_steps_carries_the_names_of_its_own_trials_only():
    trials = [Trial("SAC", "Pendulum-CA", SACHypers(), seed, 4, 1000, 0.99) for seed in (0, 1, 2)]
    tables = shard_tables(trials, records([(4, 1, 0)], [(4, 3, 1)], [(4, 5, 2)]), 4.0, PROVENANCE)
    names = [block["trial"].dictionary.to_pylist() for block in tables.steps_in_blocks(6)]
    assert names == [[trials[0].id, trials[1].id], [trials[1].id, trials[2].id]]


def test_a_diverged_return_is_nan_in_the_steps_and_never_null():
    trials = [Trial("SAC", "Pendulum-CA", SACHypers(), 0, 4, 1000, 0.99)]
    (steps,) = shard_tables(trials, records([(2, 1, 0), (2, np.nan, 2)]), 4.0, PROVENANCE).steps_in_blocks(100)
    assert np.isnan(steps["episodic_return"].to_pylist()[2:]).all()
    assert steps["episodic_return"].null_count == 0


def test_episodes_that_do_not_fill_the_steps_of_their_trials_are_refused():
    short = records([(2, 1, 0), (3, 2, 2)], [(4, 3, 1)])
    trials = [Trial("SAC", "Pendulum-CA", SACHypers(), seed, 5, 1000, 0.99) for seed in (0, 1)]
    with pytest.raises(ValueError, match="the episodes have 9 steps: 2 trials of 5 were trained"):
        shard_tables(trials, short, 4.0, PROVENANCE)


def test_a_hyperparameter_of_different_types_in_different_agents_becomes_a_text():
    from agents.hypers import FreeHypers

    trials = [
        Trial("SAC", "Pendulum-CA", FreeHypers(depth=2), 0, 5, 1000, 0.99),
        Trial("GreedyAC", "Pendulum-CA", FreeHypers(depth="deep"), 0, 5, 1000, 0.99),
        Trial("GreedyAC", "Pendulum-CA", FreeHypers(other=True), 0, 5, 1000, 0.99),
    ]
    table = members_table("study", {"tune": trials})
    assert table["depth"].to_pylist() == ["2", "deep", None]
    assert table["other"].to_pylist() == [None, None, True]


def test_members_have_the_hyperparameters_of_all_agents_as_columns():
    from agents.hypers import GreedyACHypers

    trials = [
        Trial("SAC", "Pendulum-CA", SACHypers(), 0, 5, 1000, 0.99),
        Trial("GreedyAC", "Pendulum-CA", GreedyACHypers(), 0, 5, 1000, 0.99),
    ]
    table = members_table("study", {"tune": trials})
    assert table["num_action_samples"].to_pylist() == [None, 30]
    assert table["entropy_scale"].to_pylist() == [0.01, 0.01]
    assert table["study"].to_pylist() == ["study"] * 2


def test_a_trial_that_two_stages_need_has_a_row_in_each():
    first, second, third = (Trial("SAC", "Pendulum-CA", SACHypers(), seed, 5, 1000, 0.99) for seed in (0, 1, 2))
    table = members_table("study", {"tune": [first, second], "evaluate": [second, third]})
    assert table["stage"].to_pylist() == ["tune", "tune", "evaluate", "evaluate"]
    assert table["trial"].to_pylist() == [first.id, second.id, second.id, third.id]
    assert table["seed"].to_pylist() == [0, 1, 1, 2]
    assert members_table("study", {"tune": [], "evaluate": []}).num_rows == 0


def test_members_are_the_same_rows_that_each_trial_says_of_itself():
    """Settings that share an object and settings that do not, on environments where other hyperparameters apply."""
    from agents.hypers import GreedyACHypers

    shared = GreedyACHypers(entropy_scale=0.5)
    trials = [
        Trial("GreedyAC", environment, hypers, seed, 5, 1000, 0.99)
        for environment in ("Pendulum-CA", "Pendulum-DA")
        for hypers in (shared, GreedyACHypers(), GreedyACHypers(hidden_layers=(8,)))
        for seed in (3, 4)
    ]
    rows = members_table("study", {"tune": trials}).to_pylist()
    for trial, row in zip(trials, rows, strict=True):
        said = {"study": "study", "stage": "tune", "trial": trial.id, "setting": trial.setting, "agent": trial.agent}
        said |= {"environment": trial.environment, "seed": trial.seed, "steps": 5}
        hypers = {name: list(value) if isinstance(value, tuple) else value for name, value in trial.applicable_hypers.items()}
        assert {name: value for name, value in row.items() if value is not None} == said | hypers
    assert "entropy_scale" not in trials[-1].applicable_hypers


def test_members_of_a_large_study_are_quickly_made():
    from agents.hypers import GreedyACHypers

    settings = [GreedyACHypers(critic_step_size=0.1 / number) for number in range(1, 577)]
    trials = [Trial("GreedyAC", "Pendulum-CA", hypers, seed, 5, 1000, 0.99) for hypers in settings for seed in range(100)]
    for trial in trials:
        trial.__dict__.update(id=f"{trial.seed:016x}", setting="a" * 16)  # hashing them is not what is timed
    started = time.perf_counter()
    assert members_table("study", {"tune": trials}).num_rows == 57_600
    assert time.perf_counter() - started < 1.5


def test_each_trial_may_have_a_time_of_its_own():
    trials = [Trial("SAC", "Pendulum-CA", SACHypers(), seed, 5, 1000, 0.99) for seed in (0, 1)]
    tables = shard_tables(trials, records([(5, 1, 0)], [(5, 3, 1)]), [1.0, 5.0], PROVENANCE)
    assert tables.trials["wall_seconds"].to_pylist() == [1.0, 5.0]
    assert tables.trials["population"].to_pylist() == [1, 1]
