"""What a launch shows while it runs: a live table on a terminal, plain lines elsewhere."""

import contextlib
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress_bar import ProgressBar
from rich.table import Table

from cluster.tally import Row, Tally
from sweep.messages import duration

_PLAIN_SECONDS = 30.0
_STAGES = {"tune": "tuning", "evaluate": "evaluating"}
_MOST_ROWS = 24  # more do not fit a screen


class Progress:
    """Trials finished, agent-steps a second and time left of a launch, on a console."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live: Live | None = None
        self._tally: Tally | None = None
        self._update: Callable[[], None] = lambda: None
        self._last_line = 0.0
        self._waits_for_others = 0

    @contextlib.contextmanager
    def running(self, tally: Tally, num_shards: int, slots: int, update: Callable[[], None]) -> Iterator[None]:
        """Show how far a stage is. `update` is called at every tick, to bring the tally up to date."""
        self._tally, self._update = tally, update
        self._last_line = time.monotonic()
        total = tally.total
        stage = " to evaluate" if tally.stage == "evaluate" else ""
        self.note(
            f"{tally.study}: training {total.trials:,} trials{stage} ({total.steps:,} agent-steps) "
            f"in {num_shards:,} shards on {slots} worker{'s' if slots > 1 else ''}"
        )
        if not self._console.is_terminal:
            yield
            return
        with Live(console=self._console, refresh_per_second=4, get_renderable=self._table) as self._live:
            yield
        self._live = None

    @contextlib.contextmanager
    def preparing(self) -> Iterator[Callable[[str], None]]:
        """Show on a terminal what is done before the work begins, as long as it is done; nothing elsewhere."""
        if not self._console.is_terminal:
            yield lambda _text: None
            return
        with self._console.status("preparing") as status:
            yield lambda text: status.update(escape(text))

    def note(self, line: str) -> None:
        """Say something, above the table if there is one."""
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def wait_for_others(self, trials: int) -> None:
        """Say once that nothing is left here but trials that other launches train."""
        if trials and not self._waits_for_others:
            self.note(f"{trials:,} trials are being trained by another launch: waiting for them")
        self._waits_for_others = trials

    def tick(self) -> None:
        """Bring the numbers up to date, and print a line of them now and then where there is no table."""
        self._update()
        if self._tally is None or self._live is not None or time.monotonic() - self._last_line < _PLAIN_SECONDS:
            return
        self._last_line = time.monotonic()
        total = self._tally.total
        failed = f" · {total.failed:,} failed" if total.failed else ""
        self.note(
            f"{total.done:,} of {total.trials:,} trials finished{failed} · {total.share:.0%} of the steps · "
            f"{self._tally.rate:,.0f} agent-steps/s · {duration(total.left)} left"
        )

    def _table(self) -> Table:
        tally = self._tally
        assert tally is not None
        total = tally.total
        table = Table(box=None, pad_edge=False, caption_justify="left")
        table.caption = f"{tally.study} · {_STAGES[tally.stage]} · {tally.rate:,.0f} agent-steps/s"
        table.add_column("agent", no_wrap=True)
        table.add_column("environment", no_wrap=True)
        table.add_column("", width=16)
        for heading in ("steps", "trials", "failed", "left"):
            table.add_column(heading, justify="right", no_wrap=True)
        rows = sorted(tally.rows.values(), key=lambda row: (row.running == 0, row.share == 1.0))
        for row in rows[:_MOST_ROWS]:
            _add(table, row, row.agent, row.environment)
        if len(rows) > _MOST_ROWS:
            table.add_row(f"and {len(rows) - _MOST_ROWS} more")
        _add(table, total, "all", "")
        return table


def _add(table: Table, row: Row, name: str, environment: str) -> None:
    bar = ProgressBar(total=max(1, row.steps), completed=row.done_steps)
    trials, failed = f"{row.done:,}/{row.trials:,}", f"{row.failed:,}" if row.failed else ""
    table.add_row(escape(name), escape(environment), bar, f"{row.share:.0%}", trials, failed, duration(row.left))
