"""What a launch shows while it runs: a live table on a terminal, plain lines elsewhere."""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from cluster.worker import Receipt
from sweep.shards import Shard

_PLAIN_SECONDS = 30.0
_RATE_SECONDS = 30.0


class Progress:
    """Trials finished, agent-steps a second and time left of a launch, on a console."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bars: Bars | None = None
        self._done_trials = self._all_trials = self._failed_trials = 0
        self._done_steps = self._all_steps = 0
        self._under_way: Callable[[], int] = lambda: 0
        self._readings: list[tuple[float, int]] = []
        self._last_line = 0.0

    @contextlib.contextmanager
    def running(self, study: str, shards: Sequence[Shard], slots: int, under_way: Callable[[], int]) -> Iterator[None]:
        """Show progress of these shards; `under_way` gives the agent-steps done of those that are not finished."""
        self._all_trials = sum(len(shard.trials) for shard in shards)
        self._all_steps = sum(shard.agent_steps for shard in shards)
        self._under_way = under_way
        self._readings = [(time.monotonic(), 0)]
        self._last_line = time.monotonic()
        self._console.print(
            f"{study}: training {self._all_trials:,} trials ({self._all_steps:,} agent-steps) "
            f"in {len(shards):,} shards on {slots} worker{'s' if slots > 1 else ''}",
            highlight=False,
            soft_wrap=True,
        )
        if not self._console.is_terminal:
            yield
            return
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("· {task.fields[trials]} trials · {task.fields[rate]} agent-steps/s ·"),
            TimeElapsedColumn(),
            TextColumn("· {task.fields[left]} left"),
        )
        with Bars(*columns, console=self._console, refresh_per_second=4) as self._bars:
            self._bars.add_task(study, total=self._all_steps, trials=f"0/{self._all_trials:,}", rate="…", left="…")
            yield
        self._bars = None

    @contextlib.contextmanager
    def preparing(self) -> Iterator[Callable[[str], None]]:
        """Show on a terminal what is done before the work begins, as long as it is done; nothing elsewhere."""
        if not self._console.is_terminal:
            yield lambda _text: None
            return
        with self._console.status("preparing") as status:
            yield lambda text: status.update(escape(text))

    def note(self, line: str) -> None:
        """Say something before the work begins."""
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def finished(self, receipt: Receipt) -> None:
        """Count a shard that came back; one that failed is no longer waited for."""
        trials, steps = len(receipt.shard.trials), receipt.shard.agent_steps
        if receipt.error is None:
            self._done_trials += trials
            self._done_steps += steps
            return
        self._failed_trials += trials
        self._all_steps -= steps
        last = receipt.error.strip().splitlines()[-1]
        self.note(f"shard {receipt.shard.id} failed ({trials} trials): {last}")

    def tick(self) -> None:
        """Bring the display up to date."""
        now, steps = time.monotonic(), self._done_steps + self._under_way()
        self._readings.append((now, steps))
        self._readings = [reading for reading in self._readings if reading[1] <= steps]  # a worker that began again
        while len(self._readings) > 2 and now - self._readings[1][0] > _RATE_SECONDS:
            self._readings.pop(0)
        (then, before), rate = self._readings[0], 0.0
        if now > then:
            rate = max(0.0, (steps - before) / (now - then))
        left = _duration((self._all_steps - steps) / rate) if rate else "…"
        if self._bars is not None:
            trials = f"{self._done_trials:,}/{self._all_trials:,}"
            (task,) = self._bars.task_ids
            self._bars.update(task, completed=steps, total=self._all_steps, trials=trials, rate=f"{rate:,.0f}", left=left)
        elif now - self._last_line >= _PLAIN_SECONDS:
            self._last_line = now
            share = steps / self._all_steps if self._all_steps else 0.0
            failed = f" · {self._failed_trials:,} failed" if self._failed_trials else ""
            self._console.print(
                f"{self._done_trials:,} of {self._all_trials:,} trials finished{failed} · {share:.0%} of the steps · "
                f"{rate:,.0f} agent-steps/s · {left} left",
                highlight=False,
                soft_wrap=True,
            )


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {seconds:02} s" if minutes else f"{seconds} s"
