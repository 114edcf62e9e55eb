"""Ctrl-C during a launch: once drains, twice stops, a third time at once. A batch system's SIGTERM stops.

Draining: shards under way are trained to their end, nothing else begins. Stopping: workers write a checkpoint first. Before the
first shard has begun, any of them ends the launch at once.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

#: Seconds that workers have for their checkpoints before they are stopped without.
GRACE_SECONDS = 30.0


class Interrupts:
    """`draining` and `stopping` say what was asked for; `tell` is called with "drain" or "stop" when it is asked for.

    `working` is set by the launch when shards begin.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self.draining = self.stopping = self.working = False
        self._tell = tell
        self._deadline = float("inf")

    @contextmanager
    def handled(self) -> Iterator[None]:
        """Take signals, in the main thread of a process; elsewhere nothing is changed."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        if before[signal.SIGINT] is not signal.SIG_IGN:  # started in the background of a shell that wants it ignored
            signal.signal(signal.SIGINT, self._interrupted)
        signal.signal(signal.SIGTERM, self._terminated)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def check(self) -> None:
        """Raise KeyboardInterrupt when the workers have had their time to stop."""
        if time.monotonic() > self._deadline:
            raise KeyboardInterrupt

    def _interrupted(self, _number: int, _frame: FrameType | None) -> None:
        if self.stopping or not self.working:
            raise KeyboardInterrupt
        if self.draining:
            self._stop()
        else:
            self.draining = True
            self._tell("drain")

    def _terminated(self, _number: int, _frame: FrameType | None) -> None:
        if not self.working:
            raise KeyboardInterrupt
        if not self.stopping:
            self._stop()

    def _stop(self) -> None:
        self.draining = self.stopping = True
        self._deadline = time.monotonic() + GRACE_SECONDS
        self._tell("stop")
