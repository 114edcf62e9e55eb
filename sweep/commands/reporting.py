"""`sweep report` and `sweep export`: a study on a page, and its rows as plain files."""

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sweep.messages import UserError, counted
from sweep.options import DEFAULT_STORE, JsonOption, ReadStoreOption

if TYPE_CHECKING:
    from sweep.store import Store

_PAGE = Path("report.html")


class ExportFormat(StrEnum):
    """How rows are written."""

    parquet = "parquet"
    csv = "csv"


def report(
    study: Annotated[str | None, typer.Argument(metavar="STUDY", help="A study of the store; default: the only one.")] = None,
    store: ReadStoreOption = DEFAULT_STORE,
    out: Annotated[
        Path | None, typer.Option(help="The page to write, or with --json the file for that. Default: report.html.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of bootstraps and permutations.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="The same as JSON, printed or in --out.")] = False,
) -> None:
    """Write one self-contained page about a study: warnings, runs, settings, figures, tables, methods, checklist."""
    from rich.console import Console

    from analysis.report import report
    from sweep.files import write_atomically
    from sweep.store import Store

    opened = Store.open(store)
    (name,) = _studies(opened, study, "report")
    file = out or (None if as_json else _PAGE)
    if file is not None:
        file = file / _PAGE.with_suffix(".json" if as_json else ".html") if file.is_dir() else file
        if file.resolve().is_relative_to(opened.path.resolve()):
            raise UserError(f"{file}: is in the store, which holds nothing but results: choose a place outside {store}")
    with Console(stderr=True).status("reading") as status:
        made = report(opened.path, name, seed, not as_json, lambda news: status.update(f"report: {news}"))
    content = (json.dumps(made.content(), indent=1, ensure_ascii=False) + "\n").encode() if as_json else made.html()
    if file is None:
        typer.echo(content.decode(), nl=False)
        return
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, content)
    except OSError as error:
        raise UserError(f"{file}: cannot be written: {error.strerror or error}") from None
    for warning in made.warnings:
        typer.echo(f"warning: {warning.heading}: {warning.text}")
    typer.echo(f"{name}: figures and tables: {len(made.exhibits):,}; {counted(len(made.warnings), 'warning')}")
    typer.echo(f"wrote {file}")


def export(
    study: Annotated[str | None, typer.Argument(metavar="STUDY", help="A study of the store; default: all of them.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the files, outside the store.")] = Path("export"),
    store: ReadStoreOption = DEFAULT_STORE,
    format: Annotated[ExportFormat, typer.Option(help="How to write the rows.")] = ExportFormat.parquet,
    steps: Annotated[bool, typer.Option("--steps", help="Also a row for every environment step: a great many.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace files of the same names in the folder.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write the rows of a study, tables and views, as plain files for other tools."""
    from rich.console import Console

    from analysis.export import export
    from sweep.store import Store

    opened = Store.open(store)
    names = _studies(opened, study, "export", several=True)
    with Console(stderr=True).status("exporting") as status:
        written = export(opened.path, names, out, format.value, steps, force, lambda news: status.update(f"exporting {news}"))
    if as_json:
        files = [{**vars(one), "file": str(one.file)} for one in written]
        typer.echo(json.dumps({"studies": names, "files": files}))
        return
    for one in written:
        typer.echo(f"wrote {one.file}: {counted(one.rows, 'row')}")


def _studies(store: "Store", study: str | None, command: str, several: bool = False) -> list[str]:
    """Return the studies that an argument means; one, unless there may be several."""
    from sweep.studies import named

    found = named(store, study)
    if not found:
        raise UserError(f"{store.path}: there is no study in this store yet; `sweep launch` brings one")
    if len(found) > 1 and not several:
        raise UserError(f"{command}: there are several studies; say which: {', '.join(found)}")
    return found
