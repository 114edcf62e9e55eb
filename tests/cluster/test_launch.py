import io
import json
import os
import re
import time

import pyarrow.parquet as pq
import pytest
from rich.console import Console

import cluster.worker
from cluster.executor import ExecutorDiedError, InProcessExecutor
from cluster.launch import Training, launch
from cluster.progress import Progress
from sweep.grid import parse
from sweep.store import Store
from sweep.trials import expand

GRID = """
[study]
name = "tiny"
environments = ["Pendulum-CA"]
steps = 60
cutoff = 25
[seeds]
tune = 2
[sweep]
critic_step_size = [0.01, 0.001]
[[agent]]
name = "SAC"
[[agent]]
name = "GreedyAC"
"""


def snapshot(folder):
    files = [file for file in folder.rglob("*") if file.is_file()]
    return {file: (file.stat().st_mtime_ns, file.stat().st_ino, file.read_bytes()) for file in files}


def run(store, grid=GRID, start=InProcessExecutor, training=Training()):  # noqa: B008
    output = io.StringIO()
    study = parse(grid, "grid.toml")
    summary = launch(study.name, expand(study), store, start, Progress(Console(file=output, width=200)), training)
    return summary, output.getvalue()


def refuse_to_start():
    raise AssertionError("nothing is missing: no executor may be started")


def test_launching_a_finished_study_again_starts_nothing_and_touches_no_file(tmp_path):
    store = Store.create(tmp_path)
    summary, _ = run(store)
    assert (summary.trials, summary.trained, summary.failed) == (8, 8, 0)
    before = snapshot(tmp_path)
    again, output = run(store, start=refuse_to_start)
    assert (again.trials, again.finished_before, again.trained) == (8, 8, 0)
    assert snapshot(tmp_path) == before
    assert output == ""


def test_a_larger_study_trains_only_what_is_missing(tmp_path):
    store = Store.create(tmp_path)
    run(store)
    summary, _ = run(store, GRID.replace("tune = 2", "tune = 3"))
    assert (summary.trials, summary.finished_before, summary.trained) == (12, 8, 4)
    assert len(store.finished_trials()) == 12


def test_a_shard_that_fails_harms_no_other_and_is_trained_by_the_next_launch(tmp_path, monkeypatch):
    store = Store.create(tmp_path)
    original = cluster.worker.shard_tables

    def fail_for_sac(trials, *arguments):
        if trials[0].agent == "SAC":
            raise RuntimeError("the disk is on fire")
        return original(trials, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(cluster.worker, "shard_tables", fail_for_sac)
        patch.setattr("cluster.progress._PLAIN_SECONDS", 0.0)
        summary, output = run(store)
    assert (summary.trained, summary.failed) == (4, 4)
    assert "failed (4 trials), tried again in halves: RuntimeError: the disk is on fire" in output
    assert output.count("\ntrial ") == 4  # failed alone
    failures = [json.loads(file.read_text()) for file in (tmp_path / "failures").iterdir()]
    assert all("the disk is on fire" in failure["error"] and failure["reason"] == "exception" for failure in failures)
    assert {(len(failure["trials"]), failure["attempts"]) for failure in failures} == {(1, 3)}
    assert len({failure["trials"][0]["trial"] for failure in failures}) == 4
    assert "4 of 8 trials finished · 4 failed" in output
    summary, _ = run(store, GRID.replace("tune = 2", "tune = 3"))  # packed into other shards than before
    assert (summary.finished_before, summary.trained, summary.failed) == (4, 8, 0)
    assert not list((tmp_path / "failures").iterdir())


def test_a_store_that_can_take_no_failure_and_no_progress_still_trains_the_rest(tmp_path, monkeypatch):
    store = Store.create(tmp_path)
    (tmp_path / "failures").write_text("in the way")
    (tmp_path / ".progress").write_text("in the way")
    monkeypatch.setattr("cluster.worker._REPORT_SECONDS", 0.0)
    original = cluster.worker.shard_tables
    monkeypatch.setattr(
        cluster.worker, "shard_tables", lambda trials, *rest: 1 / 0 if trials[0].agent == "SAC" else original(trials, *rest)
    )
    summary, _ = run(store)
    assert (summary.trained, summary.failed) == (4, 4)


def test_a_full_disk_stops_the_launch_instead_of_training_for_nothing(tmp_path, monkeypatch):
    store = Store.create(tmp_path)

    def full(*_arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Store, "commit", full)
    grid = GRID.replace("tune = 2", "tune = 40").replace("steps = 60", "steps = 40")
    summary, output = run(store, grid)
    assert summary.store_is_unwritable
    assert (summary.trials, summary.trained, summary.failed) == (160, 0, 0)  # no trial is to blame
    assert 1 <= len(output.splitlines()) - 1 < 5
    assert "cannot be kept: OSError: [Errno 28] No space left on device" in output


def test_trials_that_another_launch_has_finished_meanwhile_are_not_claimed(tmp_path, monkeypatch):
    store, other = Store.create(tmp_path), Store.open(tmp_path)
    commit = Store.commit

    def second(self, shard, tables):
        commit(other, f"other-{shard}", tables)
        return commit(self, shard, tables)

    monkeypatch.setattr(Store, "commit", second)
    summary, _ = run(store)
    assert (summary.trained, summary.already_there, summary.finished) == (0, 8, 8)
    assert len(store.finished_trials()) == 8


def test_a_limit_trains_so_many_and_leaves_the_rest_for_later(tmp_path):
    store = Store.create(tmp_path)
    assert run(store, training=Training(limit=3))[0].trained == 3
    assert run(store)[0].trained == 5


def test_leftovers_of_killed_workers_go_after_a_day_and_not_before(tmp_path):
    store = Store.create(tmp_path)
    for name, hours in (("old", 25), ("young", 1)):
        (tmp_path / ".staging" / name).mkdir(parents=True)
        os.utime(tmp_path / ".staging" / name, (time.time() - hours * 3600,) * 2)
    run(store)
    assert [folder.name for folder in (tmp_path / ".staging").iterdir()] == ["young"]


def test_progress_is_shown_while_one_process_trains(tmp_path, monkeypatch):
    monkeypatch.setattr("cluster.worker._REPORT_SECONDS", 0.0)
    ticks = []
    run(Store.create(tmp_path), start=lambda: InProcessExecutor(lambda: ticks.append(1)))
    assert len(ticks) >= 2 * 60 // 8


def test_on_a_terminal_progress_is_a_live_bar(tmp_path):
    output = io.StringIO()
    console = Console(file=output, width=120, force_terminal=True)
    study = parse(GRID, "grid.toml")
    launch(study.name, expand(study), Store.create(tmp_path), InProcessExecutor, Progress(console))
    assert "8/8" in output.getvalue()
    assert "tiny · tuning" in output.getvalue()
    assert "100%" in output.getvalue()
    assert "agent-steps/s" in output.getvalue()
    assert "left" in output.getvalue()


def test_a_study_of_minutes_starts_no_pilot_and_says_nothing_of_it(tmp_path, monkeypatch):
    pilots = []
    monkeypatch.setattr("cluster.calibration.run_pilot", pilots.append)
    summary, output = run(Store.create(tmp_path))
    assert summary.trained == 8
    assert pilots == []
    assert "populations of" not in output


@pytest.fixture
def _worth_a_pilot(monkeypatch, tmp_path_factory):
    """Every study is calibrated, in a moment, and nothing was measured before."""
    monkeypatch.setattr("cluster.calibration.WORTH_SECONDS", 0.0)
    monkeypatch.setattr("cluster.calibration._SIZES", (16, 32))
    monkeypatch.setattr("cluster.pilot._MEASURED_SECONDS", 0.01)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))


def results(store):
    files = sorted(store.path.glob("shards/*/trials.parquet"))
    rows = [row for file in files for row in pq.read_table(file, partitioning=None).to_pylist()]
    return {row["trial"]: (row["episode_mean"], row["episodes"]) for row in rows}


@pytest.mark.usefixtures("_worth_a_pilot")
def test_a_long_study_is_calibrated_with_a_line_for_each_group_and_no_other_result(tmp_path):
    calibrated, plain = Store.create(tmp_path / "calibrated"), Store.create(tmp_path / "plain")
    summary, output = run(calibrated)
    assert summary.trained == 8
    sac, greedy, training, *_ = output.splitlines()
    assert re.fullmatch(r"SAC on Pendulum-CA: populations of 4, [\d,]+ agent-steps/s a worker \(measured in \d+ s\)", sac)
    assert greedy.startswith("GreedyAC on Pendulum-CA: populations of 4, ")
    assert training.startswith("tiny: training 8 trials")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cluster.calibration.WORTH_SECONDS", 1e9)
        patch.setenv("XDG_CACHE_HOME", str(tmp_path / "nothing"))
        run(plain)
    assert results(calibrated) == results(plain) != {}


@pytest.mark.usefixtures("_worth_a_pilot")
def test_users_code_that_fails_in_the_pilot_is_reported_by_the_training_and_harms_no_other(tmp_path, monkeypatch):
    monkeypatch.setattr("agents.algorithms.sac.SAC.update", lambda *arguments: 1 / 0)
    store = Store.create(tmp_path)
    summary, output = run(store)
    assert (summary.trained, summary.failed) == (4, 4)
    assert "SAC on Pendulum-CA: populations of 4, not measured (the pilot failed: division by zero)" in output
    failures = [json.loads(file.read_text()) for file in (tmp_path / "failures").iterdir()]
    assert all("ZeroDivisionError" in failure["error"] for failure in failures)


@pytest.mark.usefixtures("_worth_a_pilot")
def test_an_interrupt_in_the_pilot_stops_the_launch_and_closes_the_executor(tmp_path, monkeypatch):
    closed = []

    class Interrupted(InProcessExecutor):
        def gather(self, function, argument, copies):
            raise KeyboardInterrupt

        def close(self):
            closed.append(True)

    summary, _ = run(Store.create(tmp_path), start=Interrupted)
    assert (summary.interrupted, summary.trained, closed) == (True, 0, [True])


def test_the_peak_memory_of_the_workers_is_reported_whether_shards_fail_or_not(tmp_path, monkeypatch):
    import torch  # what a worker has in memory at the least

    store = Store.create(tmp_path)
    monkeypatch.setattr(cluster.worker, "shard_tables", lambda *arguments: 1 / 0)
    assert run(store)[0].peak_memory > 100e6
    monkeypatch.undo()
    ballast = torch.ones(50_000_000)  # 200 MB
    with_ballast = run(store)[0].peak_memory
    assert with_ballast > ballast.nbytes + 100e6


def test_an_interrupt_keeps_what_is_finished_and_closes_the_executor(tmp_path):
    store = Store.create(tmp_path)
    closed = []

    class Interrupted(InProcessExecutor):
        def wait(self, seconds):
            if store.finished_trials():
                raise KeyboardInterrupt
            return super().wait(seconds)

        def close(self):
            closed.append(True)

    summary, _ = run(store, start=Interrupted)
    assert summary.interrupted
    assert closed == [True]
    assert 0 < summary.trained < 8
    summary, _ = run(store)
    assert summary.trained + summary.finished_before == 8


def test_the_number_of_shards_in_flight_is_bounded(tmp_path):
    in_flight = []

    class Counting(InProcessExecutor):
        def submit(self, work):
            super().submit(work)
            in_flight.append(len(self._queue))

    grid = GRID.replace("tune = 2", "tune = 40").replace("steps = 60", "steps = 40")
    run(Store.create(tmp_path), grid, Counting)
    assert len(in_flight) > 2
    assert max(in_flight) == 2


def test_without_a_terminal_progress_is_plain_lines(tmp_path, monkeypatch):
    monkeypatch.setattr("cluster.progress._PLAIN_SECONDS", 0.0)
    _, output = run(Store.create(tmp_path))
    first, *lines = output.splitlines()
    assert first.startswith("tiny: training 8 trials (480 agent-steps) in ")
    assert lines[-1].startswith("8 of 8 trials finished · 100% of the steps · ")
    assert "\x1b" not in output


@pytest.mark.parametrize("tf32", [False, True])
def test_whether_a_gpu_may_round_reaches_the_training(tmp_path, monkeypatch, tf32):
    import agents.training

    make, asked = agents.training.Run, []

    def spy(*arguments, **options):
        asked.append(options["tf32"])
        return make(*arguments, **options)

    monkeypatch.setattr(agents.training, "Run", spy)
    run(Store.create(tmp_path / "store"), training=Training(tf32=tf32))
    assert asked and set(asked) == {tf32}


class Dies(InProcessExecutor):
    """Dies after it has trained a number of shards, with one trained whose receipt nobody gets."""

    def __init__(self, after):
        super().__init__()
        self.after = after

    def wait(self, seconds):
        receipts = super().wait(seconds)
        self.after -= len(receipts)
        if self.after < 0:
            raise ExecutorDiedError("somebody killed it")
        return receipts


def test_an_executor_that_dies_is_started_again_for_what_is_missing(tmp_path):
    store = Store.create(tmp_path)
    lives = iter([0, 1, 9])
    grid = GRID.replace("tune = 2", "tune = 20")  # six shards
    summary, output = run(store, grid, lambda: Dies(next(lives)))
    assert (summary.trained, summary.failed, summary.already_there) == (80, 0, 0)
    assert summary.agent_steps == 80 * 60
    assert output.count("in-process died, and is started again: somebody killed it") == 2
    assert not (tmp_path / "failures").exists()


def test_an_executor_that_does_not_live_is_given_up(tmp_path):
    closed = []

    class Stillborn(InProcessExecutor):
        def wait(self, seconds):
            raise ExecutorDiedError("no air")

        def close(self):
            closed.append(1)

    summary, _ = run(Store.create(tmp_path), start=Stillborn)
    assert summary.trouble == "in-process died 4 times: no air"
    assert len(closed) == 4
    assert list((tmp_path / ".launches").glob("*.json")) == []
