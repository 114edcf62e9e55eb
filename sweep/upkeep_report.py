"""What `sweep verify`, `compact` and `merge` found and did, as a user reads it."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sweep.compaction import Counts
from sweep.merging import MergeReport
from sweep.shard_checks import Problem
from sweep.verification import Report

_PLAIN_WIDTH = 130
_SHOWN = 40


def megabytes(count: int) -> str:
    """Return bytes as a user reads them."""
    return f"{count / 1e6:,.1f} MB" if count >= 50_000 else f"{count / 1e3:,.1f} kB"


def show_verification(report: Report, console: Console) -> None:
    """Print what is damaged and what to do about it, then what else there is to know."""
    what = f"{_count(report.shards, 'shard')}, {_count(report.trials, 'trial')}, {megabytes(report.bytes)}"
    if not report.problems:
        _say(console, f"All is well: {what}.")
    else:
        _show_problems(report.problems, console)
        shards = {problem.shard for problem in report.problems if problem.shard}
        if shards:
            spoiled = f"{len(report.damaged_trials):,} of {_count(report.trials, 'trial')}"
            are = "is" if len(shards) == 1 else "are"
            _say(console, f"{len(shards):,} of {_count(report.shards, 'shard')} {are} damaged: {spoiled}.")
            _say(console, "`sweep retry` puts damaged shards aside and trains their trials again.")
        if any(not problem.shard for problem in report.problems):
            _say(console, "A study's file: remove it, and launch the study's grid again; that writes it anew.")
    if report.unchecked:
        _say(console, f"{_count(len(report.unchecked), 'shard')} without checksums, written before there were any.")
    if report.leftovers:
        _say(console, f"{_count(len(report.leftovers), 'leftover')} of processes that were killed; nothing reads them:")
        _list([str(file) for file in report.leftovers], console)
    if report.quarantined:
        _say(console, f"{_count(len(report.quarantined), 'shard')} put aside earlier; nothing reads them:")
        _list([str(file) for file in report.quarantined], console)


def show_compaction(counts: Counts, console: Console) -> None:
    """Print what was put together, and what was left alone."""
    if counts.damaged:
        _show_problems(counts.damaged, console)
        _say(console, "Damaged shards were left alone: `sweep verify` says more, `sweep retry` trains them again.")
    if not counts.trials:
        _say(console, f"Nothing to put together: {_count(counts.shards_after, 'shard')}, {megabytes(counts.bytes_after)}.")
        return
    shards = f"{_count(counts.shards_before, 'shard')} became {counts.shards_after:,}"
    size = f"{megabytes(counts.bytes_before)} became {megabytes(counts.bytes_after)}"
    _say(console, f"{shards}, {size}; {_count(counts.trials, 'trial')} moved, none changed.")


def show_merge(report: MergeReport, console: Console) -> None:
    """Print what was brought, and what differs."""
    were = "was" if report.same == 1 else "were"
    _say(console, f"{_count(report.trials, 'trial')} brought; {report.same:,} {were} here already, with the same episodes.")
    for names, what in ((report.studies, "study brought"), (report.selections, "selection brought, of the study")):
        for name in names:
            _say(console, f"{what}: {name}")
    for sentence in report.study_conflicts:
        _say(console, f"conflict: {sentence}")
    if not report.conflicts:
        return
    table = _table("trial", "agent", "environment", "seed", "of", "here", "there")
    for one in report.conflicts[:_SHOWN]:
        cells = (one.trial, one.agent, one.environment, str(one.seed), str(one.store), *_differences(one.ours, one.theirs))
        table.add_row(*(escape(cell) for cell in cells))
    console.print(table)
    if len(report.conflicts) > _SHOWN:
        _say(console, f"and {len(report.conflicts) - _SHOWN:,} more (--json has them all)")
    _say(console, f"{_count(len(report.conflicts), 'trial')} with other episodes than here: the store's own rows were kept.")


def _differences(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> tuple[str, str]:
    """Return with what each was trained, as far as it differs; all of it where nothing does."""
    names = [name for name in ours if ours[name] != theirs[name]] or list(ours)
    return tuple(", ".join(str(known[name]) for name in names) for known in (ours, theirs))  # type: ignore[return-value]


def _show_problems(problems: Sequence[Problem], console: Console) -> None:
    table = _table("shard", "file", "trials", "what is wrong")
    for problem in problems[:_SHOWN]:
        file = problem.file.name if problem.shard else "/".join(problem.file.parts[-3:])
        table.add_row(problem.shard, escape(file), f"{len(problem.trials):,}" if problem.shard else "", escape(problem.what))
    console.print(table)
    if len(problems) > _SHOWN:
        _say(console, f"and {len(problems) - _SHOWN:,} more (--json has them all)")


def _table(*names: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for name in names:
        table.add_column(name, overflow="fold", justify="right" if name in ("trials", "seed") else "left")
    return table


def _list(lines: Sequence[str], console: Console) -> None:
    for line in lines[:_SHOWN]:
        _say(console, f"  {line}")
    if len(lines) > _SHOWN:
        _say(console, f"  and {len(lines) - _SHOWN:,} more")


def _say(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def plain(console: Console) -> Console:
    """Return a console that is wide enough for a table when it writes to a file or a pipe."""
    if not console.is_terminal:
        console.width = max(console.width, _PLAIN_WIDTH)
    return console
