"""Tables A.1 to A.4: the settings that a synthetic store was made to choose."""

import itertools
import math

import numpy as np
import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.figures.options import NoDataError, Options
from analysis.query import run_query
from analysis.tables import catalogue, tuned_settings
from analysis.tables.table import Table
from sweep.grid import parse
from sweep.trials import evaluation_trials, expand

GRID = """
[study]
name = "demo"
environments = ["Pendulum-CA", "Pendulum-DA"]
steps = 1000
[seeds]
tune = 2
evaluate = 3
[sweep]
critic_step_size = [0.1, 0.01, 0.001]
actor_step_size_scale = [0.1, 1.0, 10.0]
entropy_scale = [0.01, 0.1, 1.0]
[[agent]]
name = "GreedyAC"
[[agent]]
name = "SAC"
"""
BEST = {  # what is planted: step-size, κ, τ
    ("GreedyAC", "Pendulum-CA"): (0.01, 1.0, 0.1),
    ("GreedyAC", "Pendulum-DA"): (0.001, 1.0, None),
    ("SAC", "Pendulum-CA"): (0.01, 10.0, 0.1),
    ("SAC", "Pendulum-DA"): (0.01, 1.0, 1.0),
}
HYPERS = ["actor_step_size_scale", "critic_step_size", "entropy_scale"]


def score(trial) -> float:
    """100 for the planted setting on seed 0 and 102 on seed 1; ten less for each step away from it."""
    best = BEST[trial.agent, trial.environment]
    values = [trial.applicable_hypers.get(name) for name in ("critic_step_size", "actor_step_size_scale", "entropy_scale")]
    steps = [abs(math.log10(a) - math.log10(b)) for a, b in zip(values, best, strict=True) if a is not None and b is not None]
    return 100 - 10 * sum(steps) + 2 * trial.seed


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    """The study with all tuning runs, and evaluation runs of the best settings: 80, 90 and 100."""
    store = SyntheticStore(tmp_path_factory.mktemp("planted"))
    grid = parse(GRID, "grid.toml")
    by_agent = itertools.groupby(expand(grid), key=lambda trial: trial.agent)
    for _, trials in by_agent:
        store.finish_together([(store.plan_trial("demo", trial), [score(trial)]) for trial in trials])
    chosen = {}
    for trial in expand(grid):
        if score(trial) - 2 * trial.seed > 99.9:
            chosen[trial.agent, trial.environment] = (trial.agent, trial.environment, trial.hypers)
    for trial in evaluation_trials(grid, list(chosen.values())):
        store.finish(store.plan_trial("demo", trial, "evaluate"), [80.0 + 10 * (trial.seed - 2)])
    return store.write_studies()


def built(store, study="demo", **options: object) -> Table:
    return tuned_settings.build(connect(store), study, Options(**options))


def test_each_environment_has_the_setting_that_was_planted(planted):
    table = built(planted, by="per-environment")
    assert list(table.data.columns[:5]) == ["agent", "environment", *HYPERS]
    for row in table.data.to_dict("records"):
        step_size, kappa, tau = BEST[row["agent"], row["environment"]]
        assert (row["actor_step_size_scale"], row["critic_step_size"]) == (kappa, step_size)
        assert row["entropy_scale"] == tau if tau is not None else np.isnan(row["entropy_scale"])
        assert (row["mean"], row["standard_error"], row["num_seeds"]) == pytest.approx((101, 1, 2))
        assert row["evaluation_mean"] == pytest.approx(90)
        assert row["evaluation_standard_error"] == pytest.approx(10 / math.sqrt(3))
        assert (row["num_evaluation_seeds"], row["runner_up_mean"]) == (3, pytest.approx(91))
    assert len(table.data) == 4
    assert table.notes[0] == "study demo: tuned per environment by episode_mean; computed from the tuning runs there are now"
    edges = [note for note in table.notes if "something better may lie beyond" in note]
    assert [note.split(":")[0] for note in edges] == ["GreedyAC on Pendulum-DA", "SAC on Pendulum-CA", "SAC on Pendulum-DA"]
    assert "critic_step_size is at an end" in edges[0]
    assert not any("exactly as good" in note for note in table.notes)


def test_a_table_of_one_agent_leaves_out_what_does_not_apply(planted):
    entry = catalogue.find("A.2")
    table = entry.load().build(connect(planted), "demo", entry.options)
    assert table.data["agent"].unique().tolist() == ["GreedyAC"]
    assert table.text().count("NULL") == 1  # GreedyAC has no entropy scale with discrete actions
    only_discrete = built(planted, agents=("GreedyAC",), environments=("*-DA",))
    assert "entropy_scale" not in only_discrete.data.columns


def test_across_environments_one_row_an_agent_has_what_is_best_on_average(planted):
    table = built(planted, by="across-environments")
    rows = {row["agent"]: row for row in table.data.to_dict("records")}
    assert list(rows) == ["GreedyAC", "SAC"]
    # GreedyAC is one step from the best on one of two environments with either step-size, SAC two steps with any compromise
    greedy = rows["GreedyAC"]
    assert (greedy["actor_step_size_scale"], greedy["entropy_scale"]) == (1.0, 0.1)
    assert greedy["critic_step_size"] in (0.01, 0.001)
    assert greedy["normalized"] == pytest.approx(1 - (102 - (101 + 91) / 2) / 102)
    assert rows["SAC"]["normalized"] == pytest.approx(1 - (102 - (101 + 101 - 20) / 2) / 102)
    # over seeds: (100 + 90) / 2 and (102 + 92) / 2, of 102
    assert greedy["standard_error"] == pytest.approx(math.sqrt(2) / 102 / math.sqrt(2))
    assert (greedy["num_seeds"], greedy["num_environments"]) == (2, 2)
    assert "normalizer thesis" in table.notes[0]
    assert any("GreedyAC: 1 other setting is exactly as good" in note for note in table.notes)


def test_the_query_gives_the_table(planted):
    for by in ("per-environment", "across-environments"):
        table = built(planted, by=by)
        rows = run_query(planted, table.sql).to_pylist()
        assert [row["critic_step_size"] for row in rows] == table.data["critic_step_size"].to_list()


def test_evaluation_across_environments_is_normalized_on_the_scale_of_the_selection(real_store):
    table = built(real_store, "chapter-6", by="across-environments")
    connection = connect(real_store)
    for row in table.data.to_dict("records"):
        means = connection.execute(
            """
            SELECT avg(normalized_scores.score) FROM normalized_scores
            INNER JOIN selections USING (study, agent, environment, setting, normalizer)
            WHERE study = 'chapter-6' AND stage = 'evaluate' AND selections.by = 'across-environments' AND agent = ?
            """,
            [row["agent"]],
        ).fetchone()
        assert row["evaluation_normalized"] == pytest.approx(means[0], rel=1e-12)
        assert row["evaluation_standard_error"] > 0
        assert (row["num_environments"], row["num_seeds"], row["num_evaluation_seeds"]) == (4, 3, 4)
    assert "frozen selection" in table.notes[0]


def test_choices_for_each_value_have_a_row_each(real_store):
    table = built(real_store, "figure-7-2")
    assert table.data["for_each"].nunique() == 3
    assert (table.data["num_action_samples"].astype(str) == table.data["for_each"].str.extract(r"(\d+)")[0]).all()
    with pytest.raises(NoDataError, match="no setting yet that could be chosen"):
        built(real_store, "figure-7-2", agents=("SAC",))


def test_ties_settings_left_out_and_a_missing_evaluation_are_said(tmp_path):
    store = SyntheticStore(tmp_path)
    for step_size in (0.1, 0.01, 0.001):
        for seed in range(2):
            member = store.plan("demo", "SAC", "Pendulum-CA", seed, critic_step_size=step_size)
            if (step_size, seed) != (0.001, 1):
                store.finish(member, [5.0])
    store.finish(store.plan("demo", "SAC", "Acrobot-CA", 0), [5.0])
    table = built(store.write_studies())
    assert table.notes[1:] == [
        "no evaluation runs: the means are of the runs that the settings were chosen by, and too high",
        "SAC on Acrobot-CA: one setting, nothing to choose from",
        *(note for note in table.notes if "at an end" in note),
        "SAC on Pendulum-CA: 1 other setting is exactly as good; the lowest hash was chosen",
        "SAC on Pendulum-CA: 1 setting left out, for want of runs with a score",
    ]


def test_a_normalizer_that_is_undefined_is_named(tmp_path):
    store = SyntheticStore(tmp_path)
    for step_size in (0.1, 0.01):
        for environment in ("Pendulum-CA", "Acrobot-CA"):
            store.finish(store.plan("demo", "SAC", environment, 0, critic_step_size=step_size), [-step_size])
    store.finish(store.plan("demo", "GreedyAC", "Acrobot-CA", 0), [0.0])
    with pytest.raises(NoDataError, match=r'normalizer "thesis" is undefined on Acrobot-CA, where G\* is 0'):
        built(store.write_studies(), by="across-environments", agents=("SAC",))


def test_all_diverged_leaves_nothing_to_choose(tmp_path):
    store = SyntheticStore(tmp_path)
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 0), [math.nan])
    path = store.write_studies()
    for by in ("per-environment", "across-environments"):
        with pytest.raises(NoDataError, match="no setting yet that could be chosen"):
            built(path, by=by)
