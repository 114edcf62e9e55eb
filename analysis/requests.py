"""What is asked of `sweep analyze`, checked against the catalogue and the store before anything is drawn."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import duckdb

from analysis.figures import catalogue as figures
from analysis.figures.options import Options
from analysis.tables import catalogue as tables
from sweep.messages import UserError, suggestion

FIGURE_FORMATS = ("png", "svg", "pdf", "csv", "sql")
TABLE_FORMATS = ("csv", "json", "markdown", "parquet", "sql")

Entry = figures.Entry | tables.Entry


def label(entry: Entry) -> str:
    """Return "figure 7.1" or "table A.2"."""
    return f"{'figure' if isinstance(entry, figures.Entry) else 'table'} {entry.name}"


def demonstration(entry: Entry) -> str | None:
    """Return the demonstration that a figure is drawn from; None for what is made from a store."""
    return entry.demonstration if isinstance(entry, figures.Entry) else None


def choose_formats(entries: Sequence[Entry], formats: Sequence[str]) -> list[list[str]]:
    """Return for each entry the formats that apply to it, its customary one if none does.

    Raises UserError for a format that is unknown or applies to no entry.
    """
    every = sorted({*FIGURE_FORMATS, *TABLE_FORMATS})
    for format in formats:
        if format not in every:
            raise UserError(f'unknown format "{format}": {suggestion(format, every)}')
        if not any(format in _known(entry) for entry in entries):
            whose = f"{label(entries[0])} is not" if len(entries) == 1 else "nothing that was asked for is"
            known = sorted({known for entry in entries for known in _known(entry)})
            raise UserError(f"{whose} written as {format}; there is: {', '.join(known)}")
    return [[format for format in dict.fromkeys(formats) if format in _known(entry)] or [_known(entry)[0]] for entry in entries]


def _known(entry: Entry) -> tuple[str, ...]:
    known = FIGURE_FORMATS if isinstance(entry, figures.Entry) else TABLE_FORMATS
    return tuple(format for format in known if format != "sql" or not demonstration(entry))


def check_rule(entry: Entry, asked: Options) -> None:
    """Raise UserError where a figure or table of the thesis, which shows one tuning regime, is asked for the other."""
    numbered = (*figures.THESIS, *tables.THESIS)
    if entry in numbered and asked.by and entry.options.by and asked.by != entry.options.by:
        others = [
            other.name
            for other in numbered
            if other.kind == entry.kind
            and other.options.by == asked.by
            and other.options.environments == entry.options.environments
        ]
        other = f"; {label(entry).split()[0]} {others[0]} shows the other" if others else ""
        raise UserError(f"{label(entry)} shows settings tuned {entry.options.by}{other}; --by is for the kinds without a number")


def check_names(connection: duckdb.DuckDBPyConnection, asked: Options) -> None:
    """Raise UserError for an agent, an environment or a hyperparameter that is in no study of the store."""
    for name, what in (("agents", "agent"), ("environments", "environment")):
        known = [row[0] for row in connection.execute(f"SELECT DISTINCT {what} FROM members ORDER BY ALL").fetchall()]
        for pattern in getattr(asked, name):
            if known and not any(fnmatchcase(value, pattern) for value in known):
                raise UserError(f'--{what}: no {what} "{pattern}" in the store: {suggestion(pattern, known)}')
    if asked.x or asked.over:
        hypers = [
            row[0] for row in connection.execute("SELECT DISTINCT hyperparameter FROM hyperparameters ORDER BY ALL").fetchall()
        ]
        for name in ("x", "over"):
            value = getattr(asked, name)
            if value and hypers and value not in hypers:
                raise UserError(f'--{name}: unknown hyperparameter "{value}": {suggestion(value, hypers)}')


def check_folder(out: Path, store: Path | None) -> None:
    """Raise UserError where files would be written into the store, or the folder is a file."""
    if store is not None and out.resolve().is_relative_to(store.resolve()):
        raise UserError(f"{out}: is in the store, which holds nothing but results: choose a folder outside {store}")
    if out.exists() and not out.is_dir():
        raise UserError(f"{out}: is a file; --out names a folder")
