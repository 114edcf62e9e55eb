"""One stage of a study under way: shards go out to workers, receipts come in, what fails is taken apart."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cluster.backlog import Backlog, Failed
from cluster.executor import Executor
from cluster.interrupts import GRACE_SECONDS, Interrupts
from cluster.progress import Progress
from cluster.summary import Summary
from cluster.tally import Tally
from cluster.worker import Receipt, Training, Work
from sweep import checkpoints, launches
from sweep.messages import gist
from sweep.shards import Shard
from sweep.store import Store
from sweep.trials import Trial

_IN_FLIGHT_PER_SLOT = 2
_POLL_SECONDS = 0.5


@dataclass(frozen=True)
class Packed:
    """Shards in the order in which they start; `spared` are the agent-steps that checkpoints spare some of them.

    `pack` makes more shards, of trials that another launch has given up.
    """

    shards: Sequence[Shard]
    spared: Mapping[Shard, int]
    pack: Callable[[Sequence[Trial]], Sequence[Shard]]


@dataclass(frozen=True)
class Desk:
    """What a launch works with: store, executor, its own signs of life, how to train, where to show it."""

    store: Store
    executor: Executor
    heartbeat: launches.Heartbeat
    training: Training
    progress: Progress


class StageRun:
    """A stage under way."""

    def __init__(self, desk: Desk, plan: Packed, summary: Summary, interrupts: Interrupts) -> None:
        self._desk, self._summary, self._interrupts = desk, summary, interrupts
        self._store, self._progress, self._executor = desk.store, desk.progress, desk.executor
        self._in_flight: dict[str, Shard] = {}
        self._num_shards = len(plan.shards)
        self._tally = Tally.of(summary.study, summary.stage, plan.shards, spared=plan.spared)
        neighbors = launches.Neighbors(desk.store.path, desk.heartbeat.id)
        self._backlog = Backlog(plan.shards, self._store.finished_trials, neighbors.claimed, plan.pack)
        self._elsewhere = 0
        self._given_up: set[str] = set()
        self._said: set[str] = set()

    def to_the_end(self) -> None:
        """Train all shards. Raises KeyboardInterrupt, ExecutorDiedError, or UserError when the store cannot be read any more."""
        self._interrupts.working = True
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

    def stop(self) -> None:
        """Let the workers write down where they are, for as long as they have time for it."""
        self._backlog.clear()
        self._desk.heartbeat.ask_workers_to("stop")
        deadline = time.monotonic() + GRACE_SECONDS
        while self._in_flight and time.monotonic() < deadline:
            for receipt in self._executor.wait(_POLL_SECONDS):
                self._in_flight.pop(receipt.shard.id, None)

    def _submit(self) -> None:
        begun: list[Shard] = []
        while len(self._in_flight) < _IN_FLIGHT_PER_SLOT * self._executor.slots:
            shard = self._backlog.next()
            self._count_elsewhere()
            if shard is None:
                break
            self._in_flight[shard.id] = shard
            begun.append(shard)
        if begun:
            self._update(now=True)  # others are to know before the work begins
        for shard in begun:
            self._store.clear_progress(shard.id)
            store, training = str(self._store.path.resolve()), self._desk.training
            self._executor.submit(Work(shard, store, training, self._desk.heartbeat.id))

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
        if receipt.note is not None and receipt.note not in self._said:
            self._said.add(receipt.note)
            self._progress.note(receipt.note)
        if receipt.unfinished or receipt.error is not None:
            self._store.clear_progress(shard.id)
            done = self._count_part(receipt)
            if receipt.error is not None:
                self._failed(receipt, done)
            return
        summary.already_there += len(shard.trials) - receipt.committed  # another launch was faster
        summary.agent_steps += shard.agent_steps - receipt.resumed_steps
        self._tally.trained(shard, receipt.resumed_steps)
        self._backlog.succeeded(shard)

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
        error = gist(receipt.error or receipt.reason)
        shard = receipt.shard
        if receipt.store_is_unwritable:  # no trial is to blame
            self._summary.store_is_unwritable = True
            self._progress.note(f"shard {shard.id} ({len(shard.trials)} trials) cannot be kept: {error}")
            return
        checkpoints.remove(self._store.path, shard.id)
        failed: Failed | None = self._backlog.failed(receipt, done)
        if failed is None:
            self._progress.note(f"shard {shard.id} failed ({len(shard.trials)} trials), tried again in halves: {error}")
            return
        given_up = failed.shard.trials
        self._summary.failed += len(given_up)
        self._given_up.update(trial.id for trial in given_up)
        self._tally.failed(given_up)
        self._store.record_failure(failed.shard.id, given_up, receipt.reason, receipt.host, receipt.error or "", failed.attempts)
        who = f"trial {given_up[0].id}" if len(given_up) == 1 else f"shard {failed.shard.id} ({len(given_up)} trials)"
        self._progress.note(f"{who} failed: {error}")

    def _update(self, *, now: bool = False) -> None:
        running = {shard: self._store.progress([shard.id]) for shard in self._in_flight.values()}
        self._tally.read(running, self._backlog.waiting)
        self._desk.heartbeat.beat(self._news, now=now)

    def _news(self) -> dict[str, Any]:
        trials = [trial.id for shard in self._in_flight.values() for trial in shard.trials]
        return {**self._tally.to_json(), "workers": self._executor.slots, "trials": trials}
