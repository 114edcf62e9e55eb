"""What runs where the training happens: one shard, from its trials to its committed rows."""

import contextlib
import errno
import functools
import socket
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from agents.registry import find_algorithm
from cluster import machine
from cluster.checkpointing import Checkpointing
from sweep import launches, provenance
from sweep.failures import EXCEPTION, MEMORY, STORE
from sweep.messages import UserError
from sweep.provenance import Provenance
from sweep.shards import Shard
from sweep.store import Store
from sweep.tables import ShardTables, shard_tables
from sweep.trials import Trial

if TYPE_CHECKING:
    from agents.records import Records

_REPORT_SECONDS = 1.0
_COMMIT_SECONDS = 60.0
_STEPS_AT_ONCE = 8  # between two looks at the clock
_TRANSIENT = (errno.EIO, errno.ESTALE, errno.EINTR, errno.EAGAIN)  # of a network's file system
_COMMIT_TRIES, _TRY_AGAIN_SECONDS = 3, 5.0


@dataclass(frozen=True)
class Training:
    """How shards are trained: on which device (auto, cpu, cuda), with how many threads each, at most how many trials.

    `tf32`: whether a GPU may round the operands of matrix products. `checkpoint_seconds`: how long a shard trains between two
    checkpoints.
    """

    device: str = "cpu"
    threads: int = 1
    limit: int | None = None
    tf32: bool = False
    checkpoint_seconds: float = 300.0


@dataclass(frozen=True)
class Work:
    """A shard, the store that its rows go to, how it is to be trained, and the launch (`sweep.launches`) that asks for it."""

    shard: Shard
    store: str
    training: Training = Training()
    launch: str = ""


@dataclass(frozen=True)
class Receipt:
    """What a worker sends back: never rows, which are in the store. `error` is a traceback, or None; `reason` its class.

    `committed` counts the trials that were not in the store already, `diverged` those of them that diverged. `tries`: how
    often the shard was begun. `culprit` is the trial that raised, where one trial alone did. `unfinished`: the launch asked the
    worker to stop, or not to begin. `resumed_steps` are the agent-steps that a checkpoint spared. `note` is something that a user
    should know. `store_is_unwritable` says that no other shard's rows could be committed either. `peak_memory` is the most bytes
    that the worker had in memory meanwhile.
    """

    shard: Shard
    host: str
    committed: int = 0
    diverged: int = 0
    error: str | None = None
    reason: str = EXCEPTION
    tries: int = 1
    culprit: Trial | None = None
    unfinished: bool = False
    resumed_steps: int = 0
    note: str | None = None
    store_is_unwritable: bool = False
    peak_memory: int = 0


class _StoppedError(Exception):
    """The launch asked this worker to stop."""


class _CommitError(Exception):
    """The store did not take the rows; the cause says why."""


class _TrialError(Exception):
    """One trial of a shard raised; its cause says what."""

    def __init__(self, trial: Trial) -> None:
        super().__init__(trial.id)
        self.trial = trial


def run_shard(work: Work, on_progress: Callable[[], None] | None = None) -> Receipt:
    """Train a shard and commit its rows. An error is returned, not raised. `on_progress` is called about once a second."""
    machine.reset_peak()
    receipt = Receipt(work.shard, socket.gethostname())
    try:
        desk = _Desk(work, on_progress)
    except Exception as error:
        return replace(receipt, error=_traceback_of(error))
    try:
        desk.look_for_notes("drain", "stop")
        train = _train_functions if find_algorithm(work.shard.trials[0].agent).one_trial else _train_population
        if desk.missing():
            train(desk)
    except _StoppedError:
        receipt = replace(receipt, unfinished=True)
    except _TrialError as error:
        receipt = replace(receipt, error=_traceback_of(error.__cause__ or error), culprit=error.trial)
    except _CommitError as error:
        receipt = replace(receipt, error=_traceback_of(error.__cause__ or error), reason=STORE, store_is_unwritable=True)
    except MemoryError as error:
        receipt = replace(receipt, error=_traceback_of(error), reason=MEMORY)
    except Exception as error:
        receipt = replace(receipt, error=_traceback_of(error))
    return replace(
        receipt,
        committed=desk.committed,
        diverged=desk.diverged,
        resumed_steps=desk.resumed_steps,
        note=desk.note,
        peak_memory=machine.peak_bytes(),
    )


def _traceback_of(error: BaseException) -> str:
    return "".join(traceback.format_exception(error))


def device_of(name: str) -> str:
    """Return the device that a name stands for: "auto" is a GPU if there is one. Imports torch."""
    import torch

    return ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name


@functools.cache
def _store_at(path: str) -> Store:
    """Return the store, the same for all of a process' shards: what it has read of finished trials, it need not read again."""
    return Store.open(path)


class _Desk:
    """What a worker has before it: the work, its store, how far it is, and the launch's notes."""

    def __init__(self, work: Work, on_progress: Callable[[], None] | None) -> None:
        self.work, self.trials = work, work.shard.trials
        self.store = _store_at(work.store)
        self.committed = self.diverged = self.resumed_steps = 0
        self.note: str | None = None
        self._on_progress = on_progress
        self._last = time.monotonic()

    def missing(self) -> list[Trial]:
        """Return the trials that the store lacks: this may be the second try, after rows of the first were committed."""
        with contextlib.suppress(UserError):  # a damaged shard of others: the commit will see what it can do
            finished = self.store.finished_trials()
            return [trial for trial in self.trials if trial.id not in finished]
        return list(self.trials)

    def commit(self, shard: Shard, tables: ShardTables) -> None:
        """Commit rows. Raises _CommitError; what a network's file system may get over is tried again before."""
        for tries in range(1, _COMMIT_TRIES + 1):
            try:
                self.committed += self.store.commit(shard.id, tables)
                return
            except (OSError, UserError) as error:
                if getattr(error, "errno", None) not in _TRANSIENT or tries == _COMMIT_TRIES:
                    raise _CommitError from error
                time.sleep(_TRY_AGAIN_SECONDS)

    def look_for_notes(self, *notes: str) -> None:
        """Raise _StoppedError when the launch has left one of these notes."""
        if any(launches.asked_to(self.store.path, self.work.launch, note) for note in notes):
            raise _StoppedError

    def report(self, agent_steps: int) -> None:
        """Say how far the shard is, and look for notes, about once a second."""
        if time.monotonic() - self._last >= _REPORT_SECONDS:
            self._last = time.monotonic()
            self.store.report_progress(self.work.shard.id, agent_steps)
            if self._on_progress is not None:
                self._on_progress()
            self.look_for_notes("stop")


def _train_population(desk: _Desk) -> None:
    import torch

    from agents import kernels
    from agents.evaluation import Evaluation
    from agents.training import Run

    trials, first, training = desk.trials, desk.trials[0], desk.work.training
    torch.set_num_threads(training.threads)
    device = device_of(training.device)
    # before the training: the code may change meanwhile
    origin = provenance.of_this_process(device, kernels.engine_name(device, training.tf32))

    def make() -> Run:
        return Run(
            first.agent,
            first.environment,
            [trial.hypers for trial in trials],
            [trial.seed for trial in trials],
            steps=first.steps,
            cutoff=first.cutoff,
            discount=first.discount,
            device=device,
            tf32=training.tf32,
            evaluation=Evaluation(*first.evaluation) if first.evaluation else None,
        )

    checkpoints = Checkpointing(desk.store.path, desk.work.shard, origin, training.threads, training.checkpoint_seconds)
    run = checkpoints.begin(make)
    desk.resumed_steps = run.step * len(trials)
    try:
        while run.step < run.steps:
            run.advance(min(_STEPS_AT_ONCE, run.steps - run.step))
            desk.report(run.step * len(trials))
            if checkpoints.is_due():
                checkpoints.save(run)
    except _StoppedError:
        checkpoints.save(run)
        raise
    desk.note = checkpoints.problem
    records = run.finish()
    try:
        desk.commit(desk.work.shard, shard_tables(trials, records, checkpoints.seconds, origin))
    except _CommitError:
        checkpoints.save(run)
        raise
    desk.diverged = int((records.diverged_at > 0).sum())
    checkpoints.discard()
    desk.store.clear_progress(desk.work.shard.id)


def _train_functions(desk: _Desk) -> None:
    """Train the trials one after another. What is done is committed every _COMMIT_SECONDS, at the end, and when one raises."""
    origin = provenance.of_this_process("unknown", "function")
    done = _Done(desk, origin)
    try:
        for trial in desk.missing():
            desk.look_for_notes("drain", "stop")
            before = sum(known.steps for known in desk.trials[: desk.trials.index(trial)])
            done.train(trial, lambda step, before=before: desk.report(before + step))  # type: ignore[misc]
    finally:
        done.commit()
    desk.store.clear_progress(desk.work.shard.id)


class _Done:
    """Trials of functions that are trained and not committed yet."""

    def __init__(self, desk: _Desk, origin: Provenance) -> None:
        self._desk, self._origin = desk, origin
        self._trials: list[Trial] = []
        self._records: list[Records] = []
        self._seconds: list[float] = []
        self._last = time.monotonic()

    def train(self, trial: Trial, on_step: Callable[[int], None]) -> None:
        from agents.function import train_function

        config = {"environment": trial.environment, "steps": trial.steps, "cutoff": trial.cutoff, "discount": trial.discount}
        started = time.monotonic()
        try:
            function = find_algorithm(trial.agent).load()
            records = train_function(function, config | trial.hypers.as_dict(), trial.seed, on_step)
        except _StoppedError:
            raise
        except Exception as error:
            raise _TrialError(trial) from error
        self._trials.append(trial)
        self._records.append(records)
        self._seconds.append(time.monotonic() - started)
        if time.monotonic() - self._last > _COMMIT_SECONDS:
            self.commit()

    def commit(self) -> None:
        from agents.records import side_by_side

        if not self._trials:
            return
        records = side_by_side(self._records)
        tables = shard_tables(self._trials, records, self._seconds, self._origin)
        self._desk.commit(Shard(tuple(self._trials)), tables)
        self._desk.diverged += int((records.diverged_at > 0).sum())
        self._trials, self._records, self._seconds = [], [], []
        self._last = time.monotonic()
