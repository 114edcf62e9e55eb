"""From a stage's trials to finished rows: find what is missing, pack it into shards, keep the workers busy."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from cluster.backlog import Backlog, Failed
from cluster.calibration import Calibrations, calibrate, reports
from cluster.executor import Executor, ExecutorDiedError
from cluster.interrupts import Interrupts
from cluster.progress import Progress
from cluster.resuming import resumable
from cluster.tally import Tally
from cluster.worker import Receipt, Training, Work
from sweep import launches
from sweep.messages import UserError
from sweep.plan import makespan
from sweep.shards import Shard, Size, pack
from sweep.store import Store
from sweep.trials import Trial

_IN_FLIGHT_PER_SLOT = 2
_MOST_DEATHS = 3
_POLL_SECONDS = 0.5
_AS_USUAL = Training()


@dataclass
class Summary:
    """What a launch did in one stage. Rates are in agent-steps a second, over wall-clock time and all workers.

    `peak_memory` is the most bytes that a worker had in memory.
    """

    study: str
    trials: int
    finished_before: int
    stage: str = "tune"
    trained: int = 0
    diverged: int = 0
    failed: int = 0
    agent_steps: int = 0
    seconds: float = 0.0
    interrupted: bool = False
    already_there: int = 0
    store_is_unwritable: bool = False
    peak_memory: int = 0

    @property
    def finished(self) -> int:
        """Trials of the stage that are in the store."""
        return self.finished_before + self.trained + self.already_there

    @property
    def agent_steps_per_second(self) -> float:
        """Agent-steps trained a second of the launch; 0 when nothing was trained."""
        return self.agent_steps / self.seconds if self.agent_steps else 0.0


#: Asked with the trials that are to be trained and the hours that this may take; whether to go on.
Confirm = Callable[[int, float], bool]


class Launch:
    """Trains stages of a study, one after another, with one executor, which is started only when something is missing."""

    def __init__(
        self,
        study: str,
        store: Store,
        start_executor: Callable[[], Executor],
        progress: Progress,
        training: Training = _AS_USUAL,
        confirm: Confirm | None = None,
    ) -> None:
        self.study, self.store, self.progress, self.training = study, store, progress, training
        self.interrupted = False
        self._start, self._confirm = start_executor, confirm
        self._executor: Executor | None = None
        self._left = training.limit
        self._heartbeat = launches.Heartbeat(store.path, study)
        self._neighbors = launches.Neighbors(store.path, self._heartbeat.id)

    def __enter__(self) -> Launch:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Stop whatever still runs."""
        if self._executor is not None:
            self._executor.close()
            self._executor = None
        self._heartbeat.end()

    def train(self, stage: str, trials: Sequence[Trial]) -> Summary:
        """Train those of the trials that the store lacks.

        Ctrl-C drains, and stops when it comes twice (`cluster.interrupts`). A store that cannot be written to any longer stops
        it, too; one that cannot at the start raises UserError.
        """
        summary = Summary(self.study, len(trials), 0, stage)
        missing = self._missing(trials)
        summary.finished_before = len(trials) - len(missing)
        if not missing:
            return summary
        if self._executor is None:
            self.store.check_writable()
            self.store.clean_up()
            launches.clean_up(self.store.path)
            self._executor = self._start()
        interrupts = Interrupts(self._tell)
        started = time.monotonic()
        try:
            with interrupts.handled():
                self._train(missing[: self._left], summary, interrupts)
        except KeyboardInterrupt:
            summary.interrupted = True
        summary.interrupted |= interrupts.draining
        self.interrupted |= summary.interrupted
        summary.seconds = time.monotonic() - started
        if self._left is not None:
            self._left = max(0, self._left - summary.trained)
        return summary

    def _missing(self, trials: Sequence[Trial]) -> list[Trial]:
        finished = self.store.finished_trials()
        return [trial for trial in trials if trial.id not in finished]

    def _train(self, trials: Sequence[Trial], summary: Summary, interrupts: Interrupts) -> None:
        """Train these trials; an executor that dies is started anew, a few times, for those that are still missing."""
        deaths = 0
        while True:
            assert self._executor is not None
            try:
                run = _Run(self, self._executor, self._packed(trials, self._executor), summary, interrupts)
                run.to_the_end()
                return
            except ExecutorDiedError as error:
                deaths += 1
                if deaths > _MOST_DEATHS:
                    raise UserError(f"{self._executor.name} died {deaths} times: {error}") from None
                self.progress.note(f"{self._executor.name} died, and is started again: {error}")
                self._executor.close()
                self._executor = self._start()
                trials = run.still_missing(self._missing(trials))
            if interrupts.draining:
                return

    def _tell(self, what: str) -> None:
        self._heartbeat.ask_workers_to(what)
        if what == "drain":
            self.progress.note("Draining: what is under way is trained to its end, nothing else begins. Ctrl-C again stops.")
        else:
            self.progress.note("Stopping: workers write down where they are. The next launch goes on from there.")

    def _packed(self, trials: Sequence[Trial], executor: Executor) -> list[Shard]:
        """Pack the trials into populations of the sizes that are fast here, and say what they are; checkpoints come first."""
        with self.progress.preparing() as say:
            calibrations = calibrate(trials, executor, self.training, say=say)
        begun, rest = resumable(self.store.path, trials)
        sizes = calibrations.sizes(rest)
        shards = begun + pack(rest, executor.slots, sizes)
        self._ask(shards, calibrations, executor.slots)
        for line in reports(calibrations, shards):
            self.progress.note(line)
        if begun:
            self.progress.note(f"{len(begun):,} shards go on from their checkpoints")
        return shards

    def _ask(self, shards: Sequence[Shard], calibrations: Calibrations, slots: int) -> None:
        if self._confirm is None:
            return
        sizes = calibrations.sizes([trial for shard in shards for trial in shard.trials])
        seconds = [shard.agent_steps / sizes.get(shard.group, Size()).agent_steps_per_second for shard in shards]
        if not self._confirm(sum(len(shard.trials) for shard in shards), makespan(seconds, slots) / 3600):
            raise KeyboardInterrupt


class _Run:
    """One stage under way."""

    def __init__(self, launch: Launch, executor: Executor, shards: list[Shard], summary: Summary, interrupts: Interrupts) -> None:
        self._launch, self._executor, self._summary, self._interrupts = launch, executor, summary, interrupts
        self._store, self._progress = launch.store, launch.progress
        self._in_flight: dict[str, Shard] = {}
        self._num_shards = len(shards)
        self._tally = Tally.of(launch.study, summary.stage, shards)
        self._backlog = Backlog(shards, self._store.finished_trials, launch._neighbors.claimed)
        self._elsewhere = 0
        self._given_up: set[str] = set()

    def to_the_end(self) -> None:
        with self._progress.running(self._tally, self._num_shards, self._executor.slots, self._update):
            while self._backlog or self._in_flight:
                if self._interrupts.draining or self._summary.store_is_unwritable:
                    self._backlog.clear()  # what would be trained could not be kept
                self._interrupts.check()
                self._submit()
                for receipt in self._executor.wait(_POLL_SECONDS):
                    self._in_flight.pop(receipt.shard.id, None)
                    self._take(receipt)
                if not self._in_flight and self._backlog:
                    self._progress.wait_for_others(self._backlog.deferred)
                    time.sleep(_POLL_SECONDS)
                self._progress.tick()
            self._update()

    def still_missing(self, missing: Sequence[Trial]) -> list[Trial]:
        """Return those of the missing trials that are not given up, after the executor has died.

        Shards that were committed and whose receipts were lost count as trained.
        """
        ids = {trial.id for trial in missing}
        done = [trial for shard in self._in_flight.values() for trial in shard.trials if trial.id not in ids]
        self._summary.trained += len(done)
        self._summary.agent_steps += sum(trial.steps for trial in done)
        return [trial for trial in missing if trial.id not in self._given_up]

    def _submit(self) -> None:
        while len(self._in_flight) < _IN_FLIGHT_PER_SLOT * self._executor.slots:
            shard = self._backlog.next()
            self._count_elsewhere()
            if shard is None:
                return
            self._store.clear_progress(shard.id)
            self._in_flight[shard.id] = shard
            self._heartbeat(now=True)  # others are to know before the work begins
            launch = self._launch
            self._executor.submit(Work(shard, str(self._store.path.resolve()), launch.training, launch._heartbeat.id))

    def _count_elsewhere(self) -> None:
        found = self._backlog.elsewhere[self._elsewhere :]
        self._elsewhere += len(found)
        self._summary.already_there += len(found)
        self._tally.finished(found, here=False)

    def _take(self, receipt: Receipt) -> None:
        summary, shard = self._summary, receipt.shard
        summary.peak_memory = max(summary.peak_memory, receipt.peak_memory)
        summary.trained += receipt.committed
        summary.diverged += receipt.diverged
        if receipt.unfinished or receipt.error is not None:
            self._store.clear_progress(shard.id)
            done = self._count_part(receipt)
            if receipt.error is not None:
                self._failed(receipt, done)
            return
        summary.already_there += len(shard.trials) - receipt.committed  # another launch was faster
        summary.agent_steps += shard.agent_steps - receipt.resumed_steps
        self._tally.finished(shard.trials, here=True)

    def _count_part(self, receipt: Receipt) -> set[str]:
        """Count what was committed of a shard that did not come to its end: trials of a function. Return them."""
        if not receipt.committed:
            return set()
        done = self._store.finished_trials() & {trial.id for trial in receipt.shard.trials}
        trials = [trial for trial in receipt.shard.trials if trial.id in done]
        self._summary.agent_steps += sum(trial.steps for trial in trials)
        self._tally.finished(trials, here=True)
        return done

    def _failed(self, receipt: Receipt, done: set[str]) -> None:
        self._summary.store_is_unwritable |= receipt.store_is_unwritable
        error = (receipt.error or "").strip().splitlines()[-1:] or [receipt.reason]
        shard = receipt.shard
        failed: Failed | None = self._backlog.failed(receipt, done)
        if failed is None:
            self._progress.note(f"shard {shard.id} failed ({len(shard.trials)} trials), tried again in halves: {error[0]}")
            return
        given_up = failed.shard.trials
        self._summary.failed += len(given_up)
        self._given_up.update(trial.id for trial in given_up)
        self._tally.failed(given_up)
        self._store.record_failure(failed.shard.id, given_up, receipt.reason, receipt.host, receipt.error or "", failed.attempts)
        who = f"trial {given_up[0].id}" if len(given_up) == 1 else f"shard {failed.shard.id} ({len(given_up)} trials)"
        self._progress.note(f"{who} failed: {error[0]}")

    def _update(self) -> None:
        running = {shard: self._store.progress([shard.id]) for shard in self._in_flight.values()}
        self._tally.read(running, self._backlog.waiting)
        self._heartbeat()

    def _heartbeat(self, *, now: bool = False) -> None:
        self._launch._heartbeat.beat(self._news, now=now)

    def _news(self) -> dict[str, Any]:
        trials = [trial.id for shard in self._in_flight.values() for trial in shard.trials]
        return {**self._tally.to_json(), "workers": self._executor.slots, "trials": trials}


def launch(
    study: str,
    trials: Sequence[Trial],
    store: Store,
    start_executor: Callable[[], Executor],
    progress: Progress,
    training: Training = _AS_USUAL,
    stage: str = "tune",
) -> Summary:
    """Train those trials of one stage that the store lacks; an executor is started only when there are any."""
    with Launch(study, store, start_executor, progress, training) as under_way:
        return under_way.train(stage, trials)
