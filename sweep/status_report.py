"""Status and failures as a user reads them."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sweep.messages import duration, gist
from sweep.status import StudyStatus

_PLAIN_WIDTH = 130
_COUNTS = ("planned", "done", "diverged", "failed", "running", "missing")
_SHOWN = 40


def show(studies: Sequence[StudyStatus], console: Console) -> None:
    """Print a table for each study, and a line for each launch under way."""
    _widen(console)
    if not studies:
        _say(console, "There is no study in this store yet.")
    for number, study in enumerate(studies):
        if number:
            console.print()
        planned, done, failed = study.count("planned"), study.count("done"), study.count("failed")
        share = f"{done / planned:.0%}" if planned else "nothing planned"
        _say(
            console, f"{study.study}: {done:,} of {planned:,} trials done ({share})" + (f", {failed:,} failed" if failed else "")
        )
        if done < planned:
            console.print(_table(study))
        for one in study.launches:
            _say(console, _launch(one))
        if not study.launches and study.count("missing") + failed:
            _say(console, "No launch is under way." + (" `sweep failures` says why trials failed." if failed else ""))


def _table(study: StudyStatus) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for name in ("stage", "agent", "environment"):
        table.add_column(name, overflow="fold")
    for name in _COUNTS:
        table.add_column(name, justify="right", no_wrap=True)
    for group in study.groups:
        numbers = [getattr(group, name) for name in _COUNTS]
        shown = [f"{number:,}" if number else "·" for number in numbers]
        table.add_row(group.stage, escape(group.agent), escape(group.environment), *shown)
    return table


def _launch(one: Mapping[str, Any]) -> str:
    left, rate = one.get("eta_seconds"), one.get("agent_steps_per_second") or 0.0
    return (
        f"training ({one.get('stage')}) on {one.get('host')}, process {one.get('pid')}, {one.get('workers')} workers: "
        f"{one.get('done', 0):,} of {one.get('planned', 0):,} trials · {rate:,.0f} agent-steps/s · {duration(left)} left"
    )


def show_failures(failures: Sequence[Mapping[str, Any]], console: Console, tracebacks: bool) -> None:
    """Print a row for each failed trial, and how to train one again."""
    _widen(console)
    if not failures:
        _say(console, "No trial has failed.")
        return
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for name in ("trial", "agent", "environment", "seed", "reason", "tried", "host", "error"):
        table.add_column(name, overflow="fold", justify="right" if name in ("seed", "tried") else "left")
    for one in failures[:_SHOWN]:
        cells = [one["trial"], one["agent"], one["environment"], one["seed"], one["reason"], one["attempts"], one["host"]]
        table.add_row(*(escape("" if cell is None else str(cell)) for cell in cells), escape(gist(one["error"])))
    console.print(table)
    if len(failures) > _SHOWN:
        _say(console, f"and {len(failures) - _SHOWN:,} more (--json has them all)")
    if tracebacks:
        for text, example in {one["error"]: one for one in reversed(failures)}.items():
            _say(console, f"\n{example['trial']}:\n{text.rstrip()}")
    _say(console, f"Train one alone, here: {failures[0]['reproduce']}")
    _say(console, "Train all of them again: sweep retry")


def _widen(console: Console) -> None:
    if not console.is_terminal:
        console.width = max(console.width, _PLAIN_WIDTH)


def _say(console: Console, line: str) -> None:
    console.print(line, highlight=False, markup=False, soft_wrap=True)
