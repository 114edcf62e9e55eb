"""From a study's trials to finished rows: find what is missing, pack it into shards, keep the workers busy."""

import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from cluster.calibration import calibrate, reports
from cluster.executor import Executor
from cluster.progress import Progress
from cluster.worker import Receipt, Training, Work
from sweep.shards import Shard, pack
from sweep.store import Store
from sweep.trials import Trial

_IN_FLIGHT_PER_SLOT = 2
_POLL_SECONDS = 0.5
_AS_USUAL = Training()


@dataclass
class Summary:
    """What a launch did. Rates are in agent-steps a second, over wall-clock time and all workers.

    `peak_memory` is the most bytes that a worker had in memory.
    """

    study: str
    trials: int
    finished_before: int
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
        """Trials of the study that are in the store."""
        return self.finished_before + self.trained + self.already_there

    @property
    def agent_steps_per_second(self) -> float:
        """Agent-steps trained a second of the launch; 0 when nothing was trained."""
        return self.agent_steps / self.seconds if self.agent_steps else 0.0


def launch(
    study: str,
    trials: Sequence[Trial],
    store: Store,
    start_executor: Callable[[], Executor],
    progress: Progress,
    training: Training = _AS_USUAL,
) -> Summary:
    """Train those of the trials that the store lacks. An executor is started only when there are any.

    A keyboard interrupt stops the workers: shards under way are lost, finished ones are in the store. A store that cannot be
    written to stops the launch, too.
    """
    finished = store.finished_trials()
    missing = [trial for trial in trials if trial.id not in finished]
    summary = Summary(study, len(trials), len(trials) - len(missing))
    if not missing:
        return summary
    store.clean_up()
    executor = start_executor()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # batch systems send it; Ray has just put its own handler there
    started = time.monotonic()
    try:
        shards = _packed(missing[: training.limit], executor, training, progress)
        _run(shards, store, executor, progress, training, summary)
    except KeyboardInterrupt:
        summary.interrupted = True
    finally:
        summary.seconds = time.monotonic() - started
        executor.close()
    return summary


def _packed(trials: Sequence[Trial], executor: Executor, training: Training, progress: Progress) -> list[Shard]:
    """Pack the trials into populations of the sizes that are fast here, and say what they are."""
    with progress.preparing() as say:
        calibrations = calibrate(trials, executor, training, say=say)
    shards = pack(trials, executor.slots, calibrations.sizes(trials))
    for line in reports(calibrations, shards):
        progress.note(line)
    return shards


def _run(shards: list[Shard], store: Store, executor: Executor, progress: Progress, training: Training, summary: Summary) -> None:
    waiting = deque(shards)
    in_flight: set[str] = set()
    with progress.running(summary.study, shards, executor.slots, lambda: store.progress(list(in_flight))):
        while waiting or in_flight:
            while waiting and len(in_flight) < _IN_FLIGHT_PER_SLOT * executor.slots:
                shard = waiting.popleft()
                store.clear_progress(shard.id)
                in_flight.add(shard.id)
                executor.submit(Work(shard, str(store.path.resolve()), training.device, training.threads, training.tf32))
            for receipt in executor.wait(_POLL_SECONDS):
                in_flight.discard(receipt.shard.id)
                _count(receipt, store, summary)
                progress.finished(receipt)
            if summary.store_is_unwritable:
                waiting.clear()  # what would be trained could not be kept
            progress.tick()


def _count(receipt: Receipt, store: Store, summary: Summary) -> None:
    shard = receipt.shard
    summary.peak_memory = max(summary.peak_memory, receipt.peak_memory)
    if receipt.error is not None:
        summary.failed += len(shard.trials)
        summary.store_is_unwritable |= receipt.store_is_unwritable
        store.clear_progress(shard.id)
        store.record_failure(shard.id, [trial.id for trial in shard.trials], receipt.host, receipt.error)
        return
    summary.trained += receipt.committed
    summary.already_there += len(shard.trials) - receipt.committed  # another launch was faster
    summary.diverged += receipt.diverged
    summary.agent_steps += shard.agent_steps
