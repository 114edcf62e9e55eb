"""One shard, from its trials to its rows: stopped and gone on from, raised by one trial, trained trial by trial."""

import errno
import json

import pyarrow.parquet as pq
import pytest

import cluster.worker
from agents.hypers import FreeHypers, SACHypers
from cluster.resuming import resumable
from cluster.worker import Training, Work, run_shard
from sweep import checkpoints
from sweep.launches import Heartbeat
from sweep.messages import UserError
from sweep.shards import Shard
from sweep.store import Store
from sweep.trials import Trial

FUNCTION = '''
import pathlib

def train(config, seed, report):
    """Note each call; seeds of 100 and more are too large."""
    with open("calls.txt", "a") as file:
        file.write(f"{seed}\\n")
    if seed >= 100:
        raise ValueError(f"seed {seed} is too large")
    for _ in range(4):
        report(float(seed), config["steps"] // 4)
'''
WHEN_AND_WHERE = ("wall_seconds", "finished_at")


@pytest.fixture(autouse=True)
def _at_once(monkeypatch):
    monkeypatch.setattr(cluster.worker, "_REPORT_SECONDS", 0.0)
    cluster.worker._store_at.cache_clear()


def population(count=3, steps=120):
    return Shard(tuple(Trial("SAC", "Pendulum-CA", SACHypers(batch_size=16), seed, steps, 50, 0.99) for seed in range(count)))


def rows(store):
    found = {}
    for name in ("trials", "episodes", "steps"):
        table = [
            row for folder in store.shards() for row in pq.read_table(folder / f"{name}.parquet", partitioning=None).to_pylist()
        ]
        found[name] = sorted(str({key: value for key, value in row.items() if key not in WHEN_AND_WHERE}) for row in table)
    return found


def stopping(heart, at):
    """Return what a worker calls about once a second: the `at`-th time, its launch is asked to stop."""
    calls = []

    def on_progress():
        calls.append(1)
        if len(calls) == at:
            heart.ask_workers_to("stop")

    return on_progress


@pytest.mark.parametrize("at", [1, 4, 14])
def test_a_worker_that_is_asked_to_stop_leaves_a_checkpoint_and_the_next_goes_on_from_it(tmp_path, at):
    shard = population()
    undisturbed = Store.create(tmp_path / "undisturbed")
    assert run_shard(Work(shard, str(undisturbed.path))).committed == 3
    store = Store.create(tmp_path / "stopped")
    heart = Heartbeat(store.path, "study")
    receipt = run_shard(Work(shard, str(store.path), launch=heart.id), stopping(heart, at))
    assert (receipt.unfinished, receipt.committed, receipt.error) == (True, 0, None)
    assert store.finished_trials() == set()
    (file,) = checkpoints.files(store.path)
    assert checkpoints.read_header(file)["step"] == 8 * at
    (found,), rest = resumable(store.path, [*shard.trials, *population(4).trials[3:]])
    assert found.trials == shard.trials
    assert [trial.seed for trial in rest] == [3]
    receipt = run_shard(Work(found, str(store.path)))
    assert (receipt.committed, receipt.resumed_steps) == (3, 3 * 8 * at)
    assert rows(store) == rows(undisturbed)
    assert checkpoints.files(store.path) == []


def test_checkpoints_are_written_as_often_as_asked_for_and_cost_little_time(tmp_path, monkeypatch):
    saved = []
    save = checkpoints.save
    monkeypatch.setattr(checkpoints, "save", lambda *arguments: saved.append(1) or save(*arguments))
    store = Store.create(tmp_path)
    assert run_shard(Work(population(), str(store.path))).committed == 3
    assert saved == []  # it took seconds
    monkeypatch.setattr("cluster.checkpointing._SHARE", 1e9)
    shard = Shard(population(5).trials[3:])
    run_shard(Work(shard, str(store.path), Training(checkpoint_seconds=0.0)))
    assert len(saved) == 120 // 8


@pytest.mark.parametrize("change", ["code", "engine", "versions", "processor", "threads", "trials", "damage"])
def test_a_checkpoint_of_other_code_or_another_machine_or_a_damaged_one_is_not_used(tmp_path, change):
    shard = population()
    store = Store.create(tmp_path)
    heart = Heartbeat(store.path, "study")
    run_shard(Work(shard, str(store.path), launch=heart.id), stopping(heart, 5))
    (file,) = checkpoints.files(store.path)
    if change == "damage":
        content = bytearray(file.read_bytes())
        content[-100] ^= 1
        file.write_bytes(bytes(content))
    else:
        header, state = checkpoints.load(file)
        state = {name: value.copy() if hasattr(value, "copy") else value for name, value in state.items()}
        checkpoints.save(file, header | {change: ["other"]}, state)
    receipt = run_shard(Work(shard, str(store.path)))
    assert (receipt.committed, receipt.resumed_steps) == (3, 0)
    assert checkpoints.files(store.path) == []


def test_a_disk_that_takes_no_checkpoint_stops_no_training(tmp_path):
    store = Store.create(tmp_path)
    (tmp_path / ".checkpoints").write_text("in the way")
    assert run_shard(Work(population(), str(store.path), Training(checkpoint_seconds=0.0))).committed == 3


@pytest.mark.parametrize("error", [OSError(errno.EIO, "Input/output error"), OSError(errno.ESTALE, "Stale file handle")])
def test_what_a_network_may_get_over_is_tried_again(tmp_path, monkeypatch, error):
    monkeypatch.setattr(cluster.worker, "_TRY_AGAIN_SECONDS", 0.0)
    store, commit, calls = Store.create(tmp_path), Store.commit, []

    def fails_twice(self, shard, tables):
        calls.append(1)
        if len(calls) < 3:
            raise error
        return commit(self, shard, tables)

    monkeypatch.setattr(Store, "commit", fails_twice)
    receipt = run_shard(Work(population(), str(store.path)))
    assert (receipt.committed, receipt.error, len(calls)) == (3, None, 3)


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "full"), OSError(errno.EIO, "broken"), OSError(errno.EACCES, "mine"), UserError("damaged")]
)
def test_rows_that_the_store_does_not_take_are_kept_in_a_checkpoint_and_no_trial_is_to_blame(tmp_path, monkeypatch, error):
    def fails(*_arguments):
        raise error

    monkeypatch.setattr(cluster.worker, "_TRY_AGAIN_SECONDS", 0.0)
    store = Store.create(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(Store, "commit", fails)
        receipt = run_shard(Work(population(), str(store.path)))
    assert (receipt.store_is_unwritable, receipt.reason, receipt.committed, receipt.culprit) == (True, "store", 0, None)
    assert str(error) in receipt.error
    receipt = run_shard(Work(population(), str(store.path)))
    assert (receipt.committed, receipt.resumed_steps) == (3, 3 * 120)


def test_trials_that_are_in_the_store_are_not_trained_a_second_time(tmp_path, monkeypatch):
    store = Store.create(tmp_path)
    run_shard(Work(population(), str(store.path)))
    monkeypatch.setattr("agents.training.Run", lambda *_arguments, **_options: pytest.fail("it is finished"))
    receipt = run_shard(Work(population(), str(store.path)))  # as Ray does when a worker dies after its commit
    assert (receipt.committed, receipt.error) == (0, None)


def test_a_users_own_way_to_save_that_raises_costs_the_checkpoints_only(tmp_path, monkeypatch):
    def raises(_self):
        raise KeyError("mine")

    monkeypatch.setattr("agents.algorithms.sac.SAC.state_for_checkpoint", raises, raising=False)
    monkeypatch.setattr("agents.algorithms.sac.SAC.restore_from_checkpoint", raises, raising=False)
    store = Store.create(tmp_path)
    receipt = run_shard(Work(population(), str(store.path), Training(checkpoint_seconds=0.0)))
    assert (receipt.committed, receipt.error) == (3, None)
    assert receipt.note == "SAC on Pendulum-CA has no checkpoints: 'mine'"


@pytest.mark.parametrize("header", [{"trials": None}, {"trials": [[1]]}, {"trials": "same"}, {"step": "x"}, {}])
def test_a_checkpoint_that_says_nothing_sensible_of_itself_is_passed_over(tmp_path, header):
    members = population(2).trials
    names = [members[0].id, members[0].id] if header.get("trials") == "same" else [trial.id for trial in members]
    known = {"trials": names, "step": 5} | {name: value for name, value in header.items() if value != "same"}
    checkpoints.save(checkpoints.file_of(tmp_path, "0" * 16), known if header else {}, {})
    shards, rest = resumable(tmp_path, members)
    assert (shards, rest) == ({}, list(members))


def test_of_two_checkpoints_that_share_trials_the_furthest_is_taken(tmp_path):
    members = population(4).trials
    for name, names, step in (("0" * 16, members[:3], 5), ("1" * 16, members[2:], 50)):
        header = {"trials": [trial.id for trial in names], "step": step}
        checkpoints.save(checkpoints.file_of(tmp_path, name), header, {})
    shards, rest = resumable(tmp_path, members)
    assert [(shard.trials, steps) for shard, steps in shards.items()] == [(members[2:], 100)]
    assert rest == list(members[:2])


def test_a_worker_begins_nothing_for_a_launch_that_drains(tmp_path):
    store = Store.create(tmp_path)
    heart = Heartbeat(store.path, "study")
    heart.ask_workers_to("drain")
    receipt = run_shard(Work(population(), str(store.path), launch=heart.id))
    assert (receipt.unfinished, receipt.committed) == (True, 0)
    assert checkpoints.files(store.path) == []


def test_one_that_drains_trains_what_it_has_begun_to_the_end(tmp_path):
    store = Store.create(tmp_path)
    heart = Heartbeat(store.path, "study")
    receipt = run_shard(Work(population(), str(store.path), launch=heart.id), lambda: heart.ask_workers_to("drain"))
    assert (receipt.unfinished, receipt.committed) == (False, 3)


@pytest.fixture
def function(tmp_path, monkeypatch):
    """Trials of a user's function, by seed."""
    (tmp_path / "mine_too.py").write_text(FUNCTION)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def shard(*seeds):
        return Shard(tuple(Trial("mine_too:train", "Pendulum-CA", FreeHypers(), seed, 40, 10, 0.99) for seed in seeds))

    return shard


def calls(tmp_path):
    return [int(line) for line in (tmp_path / "calls.txt").read_text().split()]


def test_trials_of_a_function_are_committed_together_each_with_its_own_time(tmp_path, function):
    store = Store.create(tmp_path / "store")
    assert run_shard(Work(function(0, 1, 2), str(store.path))).committed == 3
    (folder,) = store.shards()
    table = pq.read_table(folder / "trials.parquet", partitioning=None).to_pylist()
    assert [(row["seed"], row["episode_mean"], row["episodes"], row["population"]) for row in table] == [
        (seed, float(seed), 4, 1) for seed in (0, 1, 2)
    ]
    assert len({row["wall_seconds"] for row in table}) == 3


def test_a_trial_of_a_function_that_raises_is_named_and_those_before_it_are_kept(tmp_path, function):
    store = Store.create(tmp_path / "store")
    shard = function(0, 1, 100, 2)
    receipt = run_shard(Work(shard, str(store.path)))
    assert receipt.culprit == shard.trials[2]
    assert receipt.error.rstrip().endswith("ValueError: seed 100 is too large")
    assert receipt.committed == 2
    assert store.finished_trials() == {trial.id for trial in shard.trials[:2]}
    assert calls(tmp_path) == [0, 1, 100]


def test_trials_of_a_function_that_take_long_are_committed_one_by_one(tmp_path, function, monkeypatch):
    monkeypatch.setattr(cluster.worker, "_COMMIT_SECONDS", -1.0)
    store = Store.create(tmp_path / "store")
    assert run_shard(Work(function(0, 1, 2), str(store.path))).committed == 3
    assert len(store.shards()) == 3


def test_a_function_is_stopped_at_its_next_report_and_what_is_done_is_kept(tmp_path, function):
    store = Store.create(tmp_path / "store")
    heart = Heartbeat(store.path, "study")
    receipt = run_shard(Work(function(0, 1, 2), str(store.path), launch=heart.id), stopping(heart, 6))
    assert (receipt.unfinished, receipt.committed) == (True, 1)
    assert calls(tmp_path) == [0, 1]


def test_a_launch_of_a_function_isolates_the_trials_that_raise_and_trains_each_other_once(tmp_path, function):
    import io

    from rich.console import Console

    from cluster.executor import InProcessExecutor
    from cluster.launch import launch
    from cluster.progress import Progress

    store = Store.create(tmp_path / "store")
    trials = function(*range(20), 100, *range(20, 40), 101).trials
    summary = launch("study", trials, store, InProcessExecutor, Progress(Console(file=io.StringIO())))
    assert (summary.trained, summary.failed, summary.already_there, summary.agent_steps) == (40, 2, 0, 40 * 40)
    assert sorted(calls(tmp_path)) == [*range(40), 100, 101]
    failures = [json.loads(file.read_text()) for file in (store.path / "failures").iterdir()]
    assert sorted(failure["trials"][0]["seed"] for failure in failures) == [100, 101]
