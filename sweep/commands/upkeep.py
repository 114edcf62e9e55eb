"""`sweep verify`, `sweep compact` and `sweep merge`: keeping a store sound, small and whole."""

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from sweep.options import DEFAULT_STORE, JsonOption, ReadStoreOption, StoreOption

_DAMAGED = 2


def verify(
    store: ReadStoreOption = DEFAULT_STORE,
    quick: Annotated[bool, typer.Option("--quick", help="Leave out that `steps` is the episodes spelled out.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Check every file of a store against its checksum and every shard against its laws. Exit code 2: something is damaged."""
    from rich.console import Console

    from sweep.store import Store
    from sweep.upkeep_report import plain, show_verification
    from sweep.verification import verify

    with _saying("checking") as say:
        report = verify(Store.open(store), quick=quick, say=say)
    if as_json:
        problems = [
            {"shard": problem.shard or None, "file": str(problem.file), "trials": list(problem.trials), "what": problem.what}
            for problem in report.problems
        ]
        counts = {"shards": report.shards, "trials": report.trials, "bytes": report.bytes}
        others = {name: [str(one) for one in getattr(report, name)] for name in ("unchecked", "leftovers", "quarantined")}
        typer.echo(json.dumps({**counts, "damaged_trials": len(report.damaged_trials), "problems": problems, **others}))
    else:
        show_verification(report, plain(Console()))
    if report.problems:
        raise typer.Exit(_DAMAGED)


def compact(store: StoreOption = DEFAULT_STORE, as_json: JsonOption = False) -> None:
    """Put many small shards together into few large ones; launches may go on meanwhile. Exit code 2: something is damaged."""
    from rich.console import Console

    from sweep.compaction import compact
    from sweep.store import Store
    from sweep.upkeep_report import plain, show_compaction

    with _saying("putting together") as say:
        counts = compact(Store.open(store), say=say)
    if as_json:
        damaged = [{"shard": one.shard, "file": str(one.file), "what": one.what} for one in counts.damaged]
        typer.echo(json.dumps({**vars(counts), "damaged": damaged}))
    else:
        show_compaction(counts, plain(Console()))
    if counts.damaged:
        raise typer.Exit(_DAMAGED)


def merge(
    others: Annotated[list[Path], typer.Argument(metavar="OTHER", help="Stores to bring in; they stay as they are.")],
    store: StoreOption = DEFAULT_STORE,
    without_steps: Annotated[
        bool, typer.Option("--without-steps", help="Leave out `steps`: for a small store, to publish beside a paper.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Bring the trials, studies and selections of other stores into this one. Exit code 2: some differ from what is here."""
    from rich.console import Console

    from sweep.merging import merge
    from sweep.sample import find
    from sweep.store import Store
    from sweep.upkeep_report import plain, show_merge

    sources = [Store.open(find(other)) for other in others]
    with _saying("merging") as say:
        report = merge(Store.create(store), sources, with_steps=not without_steps, say=say)
    if as_json:
        conflicts = [{**vars(one), "store": str(one.store)} for one in report.conflicts]
        typer.echo(json.dumps({**vars(report), "conflicts": conflicts}))
    else:
        show_merge(report, plain(Console()))
    if report.conflicts or report.study_conflicts:
        raise typer.Exit(_DAMAGED)


@contextlib.contextmanager
def _saying(what: str) -> Iterator[Callable[[str], None]]:
    """Show on a terminal how far it is."""
    from rich.console import Console

    with Console(stderr=True).status(what) as status:
        yield lambda news: status.update(f"{what}: {news}")
