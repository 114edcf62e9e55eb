"""How shards get to workers: a protocol of four methods, and the executor that needs no cluster."""

from collections import deque
from collections.abc import Callable
from typing import Protocol, TypeVar

from cluster.worker import Receipt, Work, run_shard

Argument = TypeVar("Argument")
Result = TypeVar("Result")


class ExecutorDiedError(Exception):
    """The executor itself is gone, with whatever it ran: no shard is to blame. The message is its last word."""


class Executor(Protocol):
    """Runs shards somewhere. `slots` is how many can run at once, `slots_on_a_machine` how many of them on one machine."""

    name: str
    slots: int
    slots_on_a_machine: int

    def gather(self, function: Callable[[Argument], Result], argument: Argument, copies: int) -> list[Result]:
        """Run `copies` of a function at once, each in a worker of its own, all on one machine, and return what they return.

        For when no shard runs; `copies` is at most `slots_on_a_machine`. What the function raises is raised here.
        """
        ...

    def submit(self, work: Work) -> None:
        """Accept a shard; it starts when a slot is free."""
        ...

    def wait(self, seconds: float) -> list[Receipt]:
        """Return the receipts that have come in, after at most about `seconds` when there are none.

        Raises ExecutorDiedError when none will come any more.
        """
        ...

    def close(self) -> None:
        """Stop whatever still runs and free what the executor holds."""
        ...


class InProcessExecutor:
    """Trains in this process, one shard after another: for tests, debugging and machines without Ray."""

    name = "in-process"
    slots = slots_on_a_machine = 1

    def __init__(self, on_progress: Callable[[], None] | None = None) -> None:
        """`on_progress` is called about once a second while a shard is trained."""
        self._queue: deque[Work] = deque()
        self._on_progress = on_progress

    def gather(self, function: Callable[[Argument], Result], argument: Argument, copies: int) -> list[Result]:
        return [function(argument) for _ in range(copies)]

    def submit(self, work: Work) -> None:
        self._queue.append(work)

    def wait(self, seconds: float) -> list[Receipt]:
        """Train the next shard to its end, however long it takes."""
        return [run_shard(self._queue.popleft(), self._on_progress)] if self._queue else []

    def close(self) -> None:
        self._queue.clear()
