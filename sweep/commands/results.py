"""`sweep sql` and `sweep analyze`: reading what a store holds."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from sweep.messages import UserError
from sweep.options import DEFAULT_STORE, Format, StoreOption


def sql(
    query: Annotated[str | None, typer.Argument(metavar="QUERY", help="A SELECT; default: read it from standard input.")] = None,
    store: StoreOption = DEFAULT_STORE,
    format: Annotated[Format, typer.Option(help="How to write the answer.")] = Format.table,
) -> None:
    """Query a store's tables and views, read-only."""
    from analysis.query import run
    from sweep.store import Store

    run(Store.open(store).path, sys.stdin.read() if query is None else query, format.value)


def analyze(
    figure: Annotated[str | None, typer.Option(help="A figure by its number, such as 7.1.")] = None,
    list_: Annotated[bool, typer.Option("--list", help="List the figures.")] = False,
    study: Annotated[str | None, typer.Option(help="The study to draw; default: the only one with the data.")] = None,
    store: StoreOption = DEFAULT_STORE,
    out: Annotated[Path, typer.Option(help="Folder for the files.")] = Path("."),
    format: Annotated[str, typer.Option(help="png, svg, pdf, csv; several with commas.")] = "png",
) -> None:
    """Draw a figure from a store."""
    from analysis import analyze as analysis
    from sweep.store import Store

    if list_:
        for line in analysis.list_figures():
            typer.echo(line)
        return
    if figure is None:
        raise UserError("analyze: say which figure: --figure 7.1 (--list names them all)")
    formats = [part.strip() for part in format.split(",")]
    result = analysis.analyze(Store.open(store).path, figure, study, out, formats)
    for note in result.notes:
        typer.echo(note)
    for file in result.files:
        typer.echo(f"wrote {file}")
