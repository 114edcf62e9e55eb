"""`sweep sql` and `sweep analyze`: reading what a store holds."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sweep.messages import UserError
from sweep.options import DEFAULT_STORE, Format, ReadStoreOption

if TYPE_CHECKING:
    from analysis.analyze import Result


def sql(
    query: Annotated[str | None, typer.Argument(metavar="QUERY", help="A SELECT; default: read it from standard input.")] = None,
    store: ReadStoreOption = DEFAULT_STORE,
    format: Annotated[Format, typer.Option(help="How to write the answer.")] = Format.table,
) -> None:
    """Query a store's tables and views, read-only."""
    from analysis.query import run
    from sweep.store import Store

    run(Store.open(store).path, sys.stdin.read() if query is None else query, format.value)


def analyze(
    figure: Annotated[list[str] | None, typer.Option(help="A figure by its number or name, such as 7.1 or slice.")] = None,
    table: Annotated[list[str] | None, typer.Option(help="A table by its number or name, such as A.2 or performance.")] = None,
    all_: Annotated[bool, typer.Option("--all", help="Every figure and table that there is data for.")] = False,
    list_: Annotated[bool, typer.Option("--list", help="List the figures and tables.")] = False,
    study: Annotated[str | None, typer.Option(help="The study; default: the only one with the data.")] = None,
    store: ReadStoreOption = DEFAULT_STORE,
    out: Annotated[Path, typer.Option(help="Folder for the files.")] = Path("."),
    format: Annotated[
        str | None,
        typer.Option(
            help="Figures: png, svg, pdf, csv (its numbers), sql (the query of what it is made from). Tables: csv, json, "
            "markdown, parquet, sql. Several with commas. Default: png for figures, csv for tables."
        ),
    ] = None,
    x: Annotated[str | None, typer.Option(help="Hyperparameter of the horizontal axis.")] = None,
    over: Annotated[str | None, typer.Option(help="Hyperparameter of the lines, or of the vertical axis.")] = None,
    by: Annotated[str | None, typer.Option(help="Tuned per-environment or across-environments.")] = None,
    agent: Annotated[list[str] | None, typer.Option(help="Only this agent (a name or a glob).")] = None,
    environment: Annotated[list[str] | None, typer.Option(help="Only this environment (a name or a glob).")] = None,
    score: Annotated[str | None, typer.Option(help="Score of a run: episode_mean, step_mean or final_mean.")] = None,
    normalizer: Annotated[str | None, typer.Option(help="thesis, minmax, percentile or cdf.")] = None,
    band: Annotated[
        str | None, typer.Option(help="Around a mean: standard-error, student, bootstrap, min-max, runs (each run) or none.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of bootstraps and permutations.")] = 0,
) -> None:
    """Draw figures and build tables from a store."""
    from analysis import analyze as analysis
    from analysis.figures.options import Options
    from sweep.store import Store

    if list_ + all_ + bool(figure or table) > 1:
        raise UserError("analyze: --list, --all and names of figures or tables exclude one another")
    if list_:
        for line in ["figures", *analysis.list_figures(), "", "tables", *analysis.list_tables()]:
            typer.echo(line)
        return
    if not (figure or table or all_):
        raise UserError("analyze: say which figure or table: --figure 7.1, --table A.2 or --all (--list names them)")
    entries = analysis.everything() if all_ else analysis.find(figure or [], table or [])
    options = Options(
        x=x, over=over, by=by, score=score, normalizer=normalizer, band=band, seed=seed,
        agents=tuple(agent or ()), environments=tuple(environment or ()),
    )  # fmt: skip
    formats = [part.strip() for part in format.split(",")] if format is not None else []
    needs_store = any(analysis.needs_store(entry) for entry in entries)
    folder = Store.open(store).path if needs_store else None
    results = analysis.analyze(folder, entries, study, out, formats, options, _demonstrate, skip_missing=all_)
    for result in results:
        _report(result, several=len(entries) > 1)
    if all_:
        made = sum(not result.missing for result in results)
        typer.echo(f"{made} figures and tables in {out}; {len(results) - made} left out")


def _demonstrate(name: str, seed: int) -> list[dict[str, Any]]:
    """Run a demonstration of the agents package, which the analysis does not import."""
    from agents import demonstrations

    rows: list[dict[str, Any]] = getattr(demonstrations, name)(seed)
    return rows


def _report(result: "Result", several: bool) -> None:
    if result.missing:
        typer.echo(f"{result.name}: left out: {result.missing}")
        return
    if several:
        typer.echo(f"{result.name}" + (f" of study {result.study}" if result.study else ""))
    if result.text:
        typer.echo(result.text, nl=False)
    for note in result.notes:
        typer.echo(note)
    for file in result.files:
        typer.echo(f"wrote {file}")
