"""From a grid to finished rows: find what is missing, pack it into shards, keep the workers busy."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from cluster.executor import Executor
from cluster.progress import Progress
from cluster.worker import Receipt, Work
from sweep.grid import Grid
from sweep.shards import Shard, pack
from sweep.store import Store
from sweep.tables import members_table
from sweep.trials import Trial, expand

_IN_FLIGHT_PER_SLOT = 2
_POLL_SECONDS = 0.5


@dataclass
class Summary:
    """What a launch did. Rates are in agent-steps a second, over wall-clock time and all workers."""

    study: str
    trials: int
    finished_before: int
    trained: int = 0
    diverged: int = 0
    failed: int = 0
    agent_steps: int = 0
    seconds: float = 0.0
    interrupted: bool = False
    errors: list[str] = field(default_factory=list)

    @property
    def agent_steps_per_second(self) -> float:
        """Agent-steps trained a second of the launch; 0 when nothing was trained."""
        return self.agent_steps / self.seconds if self.agent_steps else 0.0


def launch(grid: Grid, store: Store, start_executor: Callable[[], Executor], progress: Progress, device: str = "cpu") -> Summary:
    """Train whatever the study needs and the store lacks. An executor is started only when something is missing.

    A keyboard interrupt stops the workers: shards under way are lost, finished ones are in the store.
    """
    trials = expand(grid)
    store.write_study(grid.name, grid.text, members_table(grid.name, "tune", trials))
    missing = _missing(trials, store)
    summary = Summary(grid.name, len(trials), len(trials) - len(missing))
    if not missing:
        return summary
    started = time.monotonic()
    executor = start_executor()
    try:
        _run(pack(missing, executor.slots), store, executor, progress, device, summary)
    except KeyboardInterrupt:
        summary.interrupted = True
    finally:
        executor.close()
        summary.seconds = time.monotonic() - started
    return summary


def _missing(trials: list[Trial], store: Store) -> list[Trial]:
    finished = store.finished_trials()
    return [trial for trial in trials if trial.id not in finished]


def _run(shards: list[Shard], store: Store, executor: Executor, progress: Progress, device: str, summary: Summary) -> None:
    waiting = deque(shards)
    in_flight: set[str] = set()
    with progress.running(summary.study, shards, executor.slots, lambda: store.progress(list(in_flight))):
        while waiting or in_flight:
            while waiting and len(in_flight) < _IN_FLIGHT_PER_SLOT * executor.slots:
                shard = waiting.popleft()
                in_flight.add(shard.id)
                executor.submit(Work(shard, str(store.path.resolve()), device))
            for receipt in executor.wait(_POLL_SECONDS):
                in_flight.discard(receipt.shard)
                _count(receipt, summary)
                progress.finished(receipt)
            progress.tick()


def _count(receipt: Receipt, summary: Summary) -> None:
    if receipt.error is not None:
        summary.failed += receipt.trials
        summary.errors.append(receipt.error)
        return
    summary.trained += receipt.trials
    summary.diverged += receipt.diverged
    summary.agent_steps += receipt.agent_steps
