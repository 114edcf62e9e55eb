"""From a stage's trials to finished rows: find what is missing, pack it into shards, keep the workers busy."""

import time
from collections.abc import Callable, Sequence
from types import TracebackType

from cluster.calibration import Calibrations, calibrate, reports
from cluster.executor import Executor, ExecutorDiedError
from cluster.interrupts import Interrupts
from cluster.progress import Progress
from cluster.resuming import resumable
from cluster.stage import Desk, Packed, StageRun
from cluster.summary import Summary
from cluster.worker import Training
from sweep import launches
from sweep.messages import UserError
from sweep.plan import makespan
from sweep.shards import Shard, Size, pack
from sweep.store import Store
from sweep.trials import Trial

_MOST_DEATHS = 3
_AS_USUAL = Training()

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
        self.interrupted = False  # somebody stopped it, or something did
        self._start, self._confirm = start_executor, confirm
        self._executor: Executor | None = None
        self._left = training.limit
        self._heartbeat = launches.Heartbeat(store.path, study)

    def __enter__(self) -> "Launch":
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

        Ctrl-C drains, and stops when it comes twice (`cluster.interrupts`). So does a store that can no longer be written to or
        read: the summary says so. One that cannot at the start raises UserError.
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
        self.interrupted |= summary.interrupted or summary.store_is_unwritable or summary.trouble is not None
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
            plan = self._packed(trials, self._executor)
            desk = Desk(self.store, self._executor, self._heartbeat, self.training, self.progress)
            run = StageRun(desk, plan, summary, interrupts)
            try:
                run.to_the_end()
                return
            except UserError as error:  # a file of the store was damaged meanwhile
                summary.trouble = str(error)
                run.stop()
                return
            except ExecutorDiedError as error:
                deaths += 1
                self._executor.close()
                if deaths > _MOST_DEATHS:
                    summary.trouble = f"{self._executor.name} died {deaths} times: {error}"
                    self._executor = None
                    return
                self.progress.note(f"{self._executor.name} died, and is started again: {error}")
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

    def _packed(self, trials: Sequence[Trial], executor: Executor) -> Packed:
        """Pack the trials into populations of the sizes that are fast here, and say what they are; checkpoints come first."""
        with self.progress.preparing() as say:
            calibrations = calibrate(trials, executor, self.training, say=say)
        spared, rest = resumable(self.store.path, trials)

        def packed(more: Sequence[Trial]) -> list[Shard]:
            """Pack trials, those with checkpoints as these were, into shards."""
            begun, others = resumable(self.store.path, more)
            return [*begun, *pack(others, executor.slots, calibrations.sizes(others))]

        shards = [*spared, *pack(rest, executor.slots, calibrations.sizes(rest))]
        self._ask(shards, calibrations, executor.slots)
        for line in reports(calibrations, shards):
            self.progress.note(line)
        if spared:
            self.progress.note(f"{len(spared):,} shards go on from their checkpoints")
        return Packed(shards, spared, packed)

    def _ask(self, shards: Sequence[Shard], calibrations: Calibrations, slots: int) -> None:
        """Ask once whether to go on. Raises KeyboardInterrupt when the answer is no."""
        if self._confirm is None:
            return
        sizes = calibrations.sizes([trial for shard in shards for trial in shard.trials])
        seconds = [shard.agent_steps / sizes.get(shard.group, Size()).agent_steps_per_second for shard in shards]
        if not self._confirm(sum(len(shard.trials) for shard in shards), makespan(seconds, slots) / 3600):
            raise KeyboardInterrupt
        self._confirm = None


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
