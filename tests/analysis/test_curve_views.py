"""Learning curves against every step counted out, and evaluation curves by hand."""

import math

import numpy as np
import pytest
from synthetic_store import STEPS, SyntheticStore

from analysis import connect

SETTING = {"setting": "a" * 16}
PLACE = ("SAC", "Pendulum-CA")
SHOWN = "WHERE \"by\" = 'per-environment' ORDER BY step"


def query(path, sql):
    connection = connect(path)
    try:
        return connection.sql(sql).to_arrow_table().to_pylist()
    finally:
        connection.close()


def random_run(generator, scale):
    """Lengths, returns and endings of a run of STEPS steps: some diverge, the last episode of some is cut off."""
    lengths = []
    while sum(lengths) < STEPS:
        lengths.append(min(int(generator.integers(20, 300)), STEPS - sum(lengths)))
    returns = [float(np.float32(value)) for value in generator.normal(-3.0, 1.0, len(lengths)) * scale]
    endings = ["terminated"] * len(lengths)
    if generator.random() < 0.7:
        endings[-1] = "budget"
    if generator.random() < 0.2:
        first = int(generator.integers(0, len(lengths)))
        returns[first:] = [math.nan] * (len(lengths) - first)
    return returns, endings, lengths


def readings_by_step(runs):
    """The reading of each run at each step, NaN for none, counted out from its episodes."""
    completed = [
        r for returns, endings, _ in runs for r, e in zip(returns, endings, strict=True) if e != "budget" and math.isfinite(r)
    ]
    worst = min(completed, default=math.nan)
    table = np.full((len(runs), STEPS), math.nan)
    for row, (returns, endings, lengths) in zip(table, runs, strict=True):
        step, last = 0, math.nan
        for value, ending, length in zip(returns, endings, lengths, strict=True):
            if not math.isfinite(value):
                last = worst
            elif ending != "budget":
                last = value
            row[step : step + length] = last
            step += length
    return table


def write_runs(path, runs):
    store = SyntheticStore(path)
    members = [store.plan("curves", *PLACE, seed, **SETTING) for seed in range(len(runs))]
    # of a run that completed nothing the study's setting could not be chosen: only its evaluation run is like that
    together = []
    for member, run in zip(members, runs, strict=True):
        together.append((member, *run, (), {"episode_mean": -1.0} if math.isfinite(run[0][-1]) else {}))
    store.finish_together([(member, returns, endings, lengths, *more) for member, returns, endings, lengths, *more in together])
    return store.write_studies()


@pytest.mark.parametrize(("seed", "scale"), [(0, 1.0), (1, 1000.0), (2, 1e7), (3, 1e-3), (4, 30.0)])
def test_a_learning_curve_is_the_mean_over_runs_at_every_step(tmp_path, seed, scale):
    generator = np.random.default_rng(seed)
    runs = [random_run(generator, scale) for _ in range(7)]
    path = write_runs(tmp_path, runs)
    table = readings_by_step(runs)
    found = query(path, f"FROM learning_curves {SHOWN}")
    assert [row["step"] for row in found] == list(range(1, STEPS + 1))
    count = np.isfinite(table).sum(axis=0)
    assert [row["num_seeds"] for row in found] == count.tolist()
    assert [row["mean"] for row in found] == pytest.approx(np.nanmean(table, axis=0), rel=1e-9)
    error = np.nanstd(table, axis=0, ddof=1) / np.sqrt(count)
    assert [row["standard_error"] for row in found] == pytest.approx(error, rel=1e-9, abs=1e-9 * scale)


def test_changes_are_the_steps_at_which_a_curve_changes(tmp_path):
    runs = [([-5, -7, -7, -2], ["terminated"] * 3 + ["budget"], [400, 200, 300, 100]), ([-5, -7], (), [500, 500])]
    found = query(write_runs(tmp_path, runs), f"FROM learning_curve_changes {SHOWN}")
    values = [tuple(row[name] for name in ("step", "last_step", "mean", "standard_error", "num_seeds")) for row in found]
    assert values == [(1, 400, -5.0, 0.0, 2), (401, 500, -6.0, 1.0, 2), (501, STEPS, -7.0, 0.0, 2)]


def test_with_one_run_a_curve_has_no_standard_error(tmp_path):
    found = query(write_runs(tmp_path, [([-5, -7], (), [500, 500])]), f"FROM learning_curve_changes {SHOWN}")
    assert [(row["mean"], row["standard_error"], row["num_seeds"]) for row in found] == [(-5.0, None, 1), (-7.0, None, 1)]


def test_a_run_that_completed_no_episode_has_no_reading(tmp_path):
    runs = [([-5.0], ["budget"], [STEPS]), ([-7.0, -9.0], (), [500, 500])]
    found = query(write_runs(tmp_path, runs), f"FROM learning_curve_changes {SHOWN}")
    assert [(row["mean"], row["num_seeds"]) for row in found] == [(-7.0, 1), (-9.0, 1)]


def test_a_last_episode_of_unknown_return_repeats_the_one_before_unless_the_run_diverged(tmp_path):
    """A function reports no return for the steps that its budget cut off: they are NaN, and the run is finished."""
    store, nan = SyntheticStore(tmp_path), math.nan
    endings, lengths = ["terminated", "terminated", "budget"], [300, 300, 400]
    finished, diverged = (store.plan("curves", *PLACE, seed, **SETTING) for seed in (0, 1))
    known = {"status": "finished", "episode_mean": -6.0}
    store.finish_together(
        [(finished, [-5.0, -7.0, nan], endings, lengths, (), known), (diverged, [-9.0, -9.0, nan], endings, lengths)]
    )
    found = query(store.write_studies(), f"FROM learning_curve_changes {SHOWN}")
    assert [(row["step"], row["mean"]) for row in found] == [(1, -7.0), (301, -8.0)]
    # from step 601 on: -7 repeated, and -9, the worst return


def test_runs_that_all_diverged_have_a_curve_only_where_there_is_a_worst_return(tmp_path):
    nan = math.nan
    path = write_runs(tmp_path / "none", [([nan], (), [STEPS]), ([nan, nan], (), [500, 500])])
    assert query(path, "FROM learning_curves") == []
    path = write_runs(tmp_path / "some", [([nan], (), [STEPS]), ([-3.0, nan], (), [500, 500])])
    found = query(path, f"FROM learning_curve_changes {SHOWN}")
    assert [(row["step"], row["mean"], row["standard_error"], row["num_seeds"]) for row in found] == [(1, -3.0, 0.0, 2)]


def test_two_studies_keep_their_curves_and_their_worst_returns_apart(tmp_path):
    store = SyntheticStore(tmp_path)
    for study, low in (("a", -50.0), ("b", -80.0)):
        for seed, returns in enumerate(([low, -10.0], [-20.0, math.nan])):
            store.finish(store.plan(study, *PLACE, seed + (10 if study == "b" else 0), **SETTING), returns)
    found = query(
        store.write_studies(), "SELECT study, step, mean FROM learning_curve_changes WHERE \"by\" LIKE 'per%' ORDER BY ALL"
    )
    assert [tuple(row.values()) for row in found] == [("a", 1, -35.0), ("a", 501, -30.0), ("b", 1, -50.0), ("b", 501, -45.0)]


def test_evaluation_curves_are_over_runs_of_the_mean_of_their_episodes(tmp_path):
    store = SyntheticStore(tmp_path)
    evaluated = [
        [(0, 1.0), (0, 3.0), (500, 10.0)],
        [(0, 6.0), (500, math.nan)],
        [(0, math.inf), (500, math.nan)],
    ]
    for seed, evaluations in enumerate(evaluated):
        store.finish(store.plan("chapter", *PLACE, seed, **SETTING), [1.0], evaluations=evaluations)
    found = query(store.write_studies(), "FROM evaluation_curves ORDER BY step")
    names = ("step", "mean", "standard_error", "min", "max", "num_seeds", "num_diverged")
    assert [tuple(row[name] for name in names) for row in found] == [
        (0, 4.0, 2.0, 2.0, 6.0, 2, 1),  # 2 and 6: deviation √8, over √2
        (500, 10.0, None, 10.0, 10.0, 1, 2),
    ]
