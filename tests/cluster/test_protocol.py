"""Tune, select, evaluate: the stages of a study, from an empty store to choices evaluated on fresh seeds."""

import io
import json
import math

import pyarrow.parquet as pq
import pytest
from rich.console import Console

from cluster import protocol
from cluster.executor import InProcessExecutor
from cluster.progress import Progress
from cluster.worker import Training
from sweep import selections
from sweep.grid import parse
from sweep.store import Store

GRID = """
[study]
name = "tiny"
environments = ["Pendulum-CA", "Pendulum-DA"]
steps = 60
cutoff = 20
[seeds]
tune = 2
evaluate = 3
[sweep]
critic_step_size = [0.1, 0.001]
[[agent]]
name = "SAC"
[[agent]]
name = "GreedyAC"
sweep = { entropy_scale = [0.1, 1.0] }
"""


def run(store, text=GRID, start=InProcessExecutor, training=Training(), **options):  # noqa: B008
    output = io.StringIO()
    outcome = protocol.run(parse(text, "grid.toml"), store, start, Progress(Console(file=output, width=200)), training, **options)
    return outcome, output.getvalue()


def refuse_to_start():
    raise AssertionError("nothing is missing: no executor may be started")


def rows(store, name):
    return [row for folder in store.shards() for row in pq.read_table(folder / name, partitioning=None).to_pylist()]


def members(store, study="tiny"):
    return pq.read_table(store.path / "studies" / study / "members.parquet", partitioning=None).to_pylist()


def chosen(store):
    return pq.read_table(store.path / "studies" / "tiny" / "selections.parquet", partitioning=None).to_pylist()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A study that has gone through all its stages."""
    store = Store.create(tmp_path_factory.mktemp("store"))
    outcome, output = run(store)
    return store, outcome, output


def test_the_settings_with_the_best_means_are_evaluated_on_fresh_seeds(finished):
    store, outcome, _ = finished
    assert [stage.stage for stage in outcome.stages] == ["tune", "evaluate"]
    assert outcome.is_complete
    trials = rows(store, "trials.parquet")
    for agent in ("SAC", "GreedyAC"):
        for environment in ("Pendulum-CA", "Pendulum-DA"):
            here = [row for row in trials if (row["agent"], row["environment"]) == (agent, environment)]
            means = {}
            for setting in {row["setting"] for row in here}:
                scores = [row["episode_mean"] for row in here if row["setting"] == setting and row["seed"] < 2]
                assert len(scores) == 2
                means[setting] = math.fsum(scores) / 2
            (choice,) = [
                row
                for row in chosen(store)
                if (row["by"], row["agent"], row["environment"]) == ("per-environment", agent, environment)
            ]
            assert choice["setting"] == max(means, key=means.get)
            assert choice["mean"] == pytest.approx(max(means.values()))
            seeds = {row["seed"] for row in here if row["setting"] == choice["setting"]}
            assert seeds == {0, 1, 2, 3, 4}
    assert {row["seed"] for row in members(store) if row["stage"] == "evaluate"} == {2, 3, 4}
    assert {row["seed"] for row in members(store) if row["stage"] == "tune"} == {0, 1}


def test_nothing_else_is_evaluated(finished):
    store, outcome, _ = finished
    settings = {(row["agent"], row["environment"], row["setting"]) for row in chosen(store)}
    evaluated = {(row["agent"], row["environment"], row["setting"]) for row in rows(store, "trials.parquet") if row["seed"] >= 2}
    assert evaluated == settings
    assert outcome.stages[1].trials == 3 * len(settings)


def test_launching_again_does_nothing_and_changes_no_file(finished):
    store, *_ = finished
    before = {file: (file.stat().st_mtime_ns, file.read_bytes()) for file in store.path.rglob("*") if file.is_file()}
    outcome, output = run(store, start=refuse_to_start)
    assert (outcome.is_complete, outcome.total("trained"), output) == (True, 0, "")
    assert {file: (file.stat().st_mtime_ns, file.read_bytes()) for file in store.path.rglob("*") if file.is_file()} == before


def test_choices_stay_when_more_evaluation_seeds_are_asked_for(finished, tmp_path):
    store = Store.create(tmp_path)
    run(store)
    before = chosen(store)
    outcome, _ = run(store, GRID.replace("evaluate = 3", "evaluate = 4"))
    assert chosen(store) == before
    assert outcome.stages[0].trained == 0
    assert outcome.stages[1].trained == len({(row["agent"], row["environment"], row["setting"]) for row in before})


def test_choices_are_made_anew_when_there_is_more_to_choose_from(tmp_path):
    store = Store.create(tmp_path)
    run(store)
    before = chosen(store)
    outcome, _ = run(store, GRID.replace("tune = 2", "tune = [0, 1, 7]").replace("evaluate = 3", "evaluate = [2, 3, 4]"))
    assert outcome.is_complete
    assert {row["num_seeds"] for row in chosen(store)} == {3}
    assert chosen(store)[0]["basis"] != before[0]["basis"]


def test_nothing_is_chosen_before_all_tuning_trials_are_there(tmp_path):
    store = Store.create(tmp_path)
    outcome, _ = run(store, training=Training(limit=3))
    assert outcome.open_stages == ["evaluate"]
    assert not outcome.is_complete
    assert selections.read_selection(store, "tiny") is None
    assert any("missing" in message for message in outcome.messages)
    outcome, _ = run(store)
    assert outcome.is_complete


def test_a_failing_setting_holds_the_selection_up_unless_partial_ones_are_allowed(tmp_path, monkeypatch):
    from agents.algorithms.sac import SAC

    original = SAC.__init__

    def fails_for_large_steps(self, population, task, stream):
        if any(hypers.critic_step_size == 0.1 for hypers in population.hypers):
            raise RuntimeError("too large")
        original(self, population, task, stream)

    monkeypatch.setattr(SAC, "__init__", fails_for_large_steps)
    store = Store.create(tmp_path)
    outcome, _ = run(store)
    assert outcome.total("failed") == 4  # 2 seeds on 2 environments
    assert outcome.stages[0].trained == 4 + 2 * (4 + 2)
    assert outcome.open_stages == ["evaluate"]
    failed = [(trial["agent"], trial["critic_step_size"]) for failure in store.failures() for trial in failure.trials]
    assert failed == [("SAC", 0.1)] * 4
    outcome, _ = run(store, allow_partial=True)
    assert [row["critic_step_size"] for row in chosen(store) if row["agent"] == "SAC"] == [0.001] * 4
    assert {row["num_left_out"] for row in chosen(store) if row["agent"] == "SAC"} == {1}
    assert outcome.stages[1].finished == outcome.stages[1].trials
    assert not outcome.is_complete  # the four are failed still
    monkeypatch.undo()
    again = protocol.again(store, ["tiny"], InProcessExecutor, Progress(Console(file=io.StringIO())), Training())
    assert [(summary.stage, summary.trained) for summary in again] == [("tune", 4)]
    assert store.failures() == []
    outcome, _ = run(store)
    assert outcome.is_complete
    assert {row["num_left_out"] for row in chosen(store)} == {0}
    assert {row["num_settings"] for row in chosen(store) if row["agent"] == "SAC"} == {2}


def test_a_study_takes_what_another_has_trained(finished, tmp_path):
    store = Store.create(tmp_path)
    run(store)
    larger = GRID.replace('name = "tiny"', 'name = "other"').replace("tune = 2", "tune = [0, 1, 9]")
    outcome, _ = run(store, larger.replace("evaluate = 3", "evaluate = [2]"))
    tune = outcome.stages[0]
    assert (tune.trials, tune.finished_before, tune.trained) == (36 - 6, 24 - 4, 10)


def test_a_limit_holds_for_both_stages_together(tmp_path):
    store = Store.create(tmp_path)
    outcome, _ = run(store, training=Training(limit=21))
    assert [stage.trained for stage in outcome.stages] == [20, 1]


def test_without_evaluation_seeds_the_first_stage_is_all(tmp_path):
    outcome, _ = run(Store.create(tmp_path), GRID.replace("evaluate = 3\n", ""))
    assert (len(outcome.stages), outcome.is_complete) == (1, True)


def test_as_json_the_stages_add_up(finished):
    _, outcome, _ = finished
    found = json.loads(json.dumps(outcome.to_json()))
    assert found["trained"] == sum(stage["trained"] for stage in found["stages"]) == found["trials"]
    assert [stage["stage"] for stage in found["stages"]] == ["tune", "evaluate"]
    assert found["agent_steps"] == 60 * found["trained"]


def test_a_plan_counts_the_most_there_can_be_and_then_what_was_chosen(finished, tmp_path):
    grid = parse(GRID, "grid.toml")
    unknown = protocol.planned(grid, None)
    assert (len(unknown.tune), len(unknown.evaluate), unknown.known) == (20, 2 * 4 * 3, False)
    known = protocol.planned(grid, finished[0])
    assert known.known
    assert {trial.id for trial in known.trials} == finished[0].finished_trials()


def test_somebody_who_says_no_has_nothing_trained(tmp_path):
    store = Store.create(tmp_path)
    asked = []
    outcome, _ = run(store, confirm=lambda trials, hours: asked.append((trials, hours)) or False)
    assert asked[0][0] == 20
    assert outcome.interrupted
    assert store.finished_trials() == set()


def test_one_is_asked_once_for_all_stages(tmp_path):
    asked = []
    outcome, _ = run(Store.create(tmp_path), confirm=lambda *numbers: asked.append(numbers) or True)
    assert (len(outcome.stages), outcome.is_complete, len(asked)) == (2, True, 1)


def test_where_nothing_has_a_score_nothing_is_chosen_and_the_study_is_not_complete(tmp_path):
    store = Store.create(tmp_path)
    for _ in range(2):
        outcome, _ = run(store, GRID.replace("steps = 60", "steps = 15"))  # no episode comes to its end
        assert (outcome.open_stages, outcome.is_complete) == (["evaluate"], False)
        assert any("nothing is chosen" in message for message in outcome.messages)


def test_nothing_is_evaluated_when_the_store_takes_nothing(tmp_path, monkeypatch):
    store = Store.create(tmp_path)
    run(store, training=Training(limit=12))
    monkeypatch.setattr(Store, "commit", lambda *_arguments: (_ for _ in ()).throw(OSError(28, "full")))
    outcome, _ = run(store, allow_partial=True)
    assert [stage.stage for stage in outcome.stages] == ["tune"]
    assert outcome.open_stages == ["evaluate"]
    assert (outcome.stages[0].store_is_unwritable, outcome.total("failed")) == (True, 0)


def test_a_partial_choice_stays_when_what_was_missing_fails_again(tmp_path, monkeypatch):
    from agents.algorithms.sac import SAC

    original = SAC.__init__

    def fails_for_large_steps(self, population, task, stream):
        if any(hypers.critic_step_size == 0.1 for hypers in population.hypers):
            raise RuntimeError("too large")
        original(self, population, task, stream)

    monkeypatch.setattr(SAC, "__init__", fails_for_large_steps)
    store = Store.create(tmp_path)
    run(store, training=Training(limit=19), allow_partial=True)
    run(store, allow_partial=True)
    before = chosen(store)
    outcome, _ = run(store, GRID.replace("evaluate = 3", "evaluate = 4"))
    assert chosen(store) == before
    assert outcome.stages[1].trained == len({(row["agent"], row["environment"], row["setting"]) for row in before})


def test_a_file_that_is_damaged_while_a_stage_runs_ends_it_with_a_message(tmp_path):
    store = Store.create(tmp_path)

    class Damages(InProcessExecutor):
        def wait(self, seconds):
            receipts = super().wait(seconds)
            for folder in store.shards()[:1]:
                (folder / "trials.parquet").write_bytes(b"")
            return receipts

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cluster.backlog._LOOK_SECONDS", 0.0)
        outcome, _ = run(store, start=Damages)
    assert "trials.parquet" in (outcome.stages[0].trouble or "")
    assert (outcome.open_stages, outcome.is_complete) == (["evaluate"], False)
