"""`sweep analyze`: draw figures and build tables of a study from a store, and save them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import duckdb
import pandas as pd

from analysis.database import connect
from analysis.figures import catalogue as figures
from analysis.figures.options import NoDataError, Options
from analysis.query import short_message
from analysis.requests import (
    FIGURE_FORMATS,
    TABLE_FORMATS,
    Entry,
    check_folder,
    check_names,
    check_rule,
    choose_formats,
    demonstration,
    label,
)
from analysis.tables import catalogue as tables
from sweep.messages import UserError, suggestion

__all__ = [
    "FIGURE_FORMATS",
    "TABLE_FORMATS",
    "Entry",
    "Result",
    "analyze",
    "everything",
    "find",
    "list_figures",
    "list_tables",
    "needs_store",
]

_SUFFIXES = {"markdown": "md"}

list_figures, list_tables = figures.list_figures, tables.list_tables

Demonstrations = Callable[[str, int], list[dict[str, Any]]]
"""Name of a demonstration and seed → its rows."""


@dataclass(frozen=True)
class Result:
    """What became of one figure or table: its study (None for a demonstration), the files written, what the user should know.

    `text`: a table as text; empty for a figure. `missing`: why there is nothing, when everything was asked for.
    """

    name: str
    study: str | None
    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    text: str = ""
    missing: str = ""


def everything() -> list[Entry]:
    """Return every figure and table of the thesis and every kind that shows something of its own, each once."""
    thesis: list[Entry] = [*figures.THESIS, *tables.THESIS]
    return [*thesis, *figures.KINDS, *tables.KINDS]


def find(figure_names: Sequence[str], table_names: Sequence[str]) -> list[Entry]:
    """Return the figures and tables of these names, each once. Raises UserError with the known names."""
    return [*map(figures.find, dict.fromkeys(figure_names)), *map(tables.find, dict.fromkeys(table_names))]


def needs_store(entry: Entry) -> bool:
    """Return whether the figure or table is made from a store."""
    return demonstration(entry) is None


def analyze(
    store: Path | None,
    entries: Sequence[Entry],
    study: str | None,
    out: Path,
    formats: Sequence[str] = (),
    options: Options | None = None,
    demonstrations: Demonstrations | None = None,
    skip_missing: bool = False,
) -> list[Result]:
    """Draw and build `entries` of `study` and write `out`/figure-7.1.png, `out`/table-A.2.csv and so on.

    Without formats: png for figures, csv for tables. Without a study: the entry's own if it has data here, else the only one that
    has; UserError if that leaves a choice. With `skip_missing`, what a study has no data for is left out and says why; otherwise
    that is a UserError as well. `store` may be None when all entries are demonstrations.
    """
    wanted = choose_formats(entries, formats)
    asked = options or Options()
    for entry in entries:
        asked.check(entry.load().TAKES, label(entry))
        check_rule(entry, asked)
    check_folder(out, store)
    connection = connect(store) if store is not None and any(map(needs_store, entries)) else None
    results = []
    try:
        if connection is not None:
            check_names(connection, asked)
        for entry, chosen_formats in zip(entries, wanted, strict=True):
            try:
                results.append(_one(connection, entry, study, asked, out, chosen_formats, demonstrations))
            except NoDataError as error:
                if not skip_missing:
                    raise
                results.append(Result(label(entry), study, missing=str(error).removeprefix(f"{label(entry)}: ")))
            except duckdb.Error as error:
                raise UserError(f"{store}: {short_message(error)}") from None
    finally:
        if connection is not None:
            connection.close()
    return results


def _one(
    connection: duckdb.DuckDBPyConnection | None,
    entry: Entry,
    study: str | None,
    asked: Options,
    out: Path,
    formats: Sequence[str],
    demonstrations: Demonstrations | None,
) -> Result:
    module = entry.load()
    options = entry.options.but(
        title=entry.title, **{name: getattr(asked, name) for name in module.TAKES}, seed=asked.seed or None
    )
    shown = demonstration(entry)
    if shown:
        assert demonstrations is not None
        made, chosen = module.draw(pd.DataFrame(demonstrations(shown, options.seed)), options.title), None
    else:
        assert connection is not None
        chosen = _choose(connection, entry, study, options)
        made = (
            module.draw(connection, chosen, options)
            if isinstance(entry, figures.Entry)
            else module.build(connection, chosen, options)
        )
    kind = "figure" if isinstance(entry, figures.Entry) else "table"
    files = [out / f"{kind}-{entry.name}.{_SUFFIXES.get(format, format)}" for format in formats]
    try:
        out.mkdir(parents=True, exist_ok=True)
        for file, format in zip(files, formats, strict=True):
            made.save(file, format)
    except OSError as error:
        raise UserError(f"{out}: the {kind} cannot be written there: {error.strerror}") from None
    return Result(label(entry), chosen, files, made.notes, made.text() if kind == "table" else "")


def _choose(connection: duckdb.DuckDBPyConnection, entry: Entry, study: str | None, options: Options) -> str:
    known = [row[0] for row in connection.execute("SELECT DISTINCT study FROM members ORDER BY study").fetchall()]
    what = label(entry)
    if not known:
        raise NoDataError(f"{what}: the store has no study yet")
    if study is not None:
        if study not in known:
            raise UserError(f'unknown study "{study}": {suggestion(study, known)}')
        return study
    candidates = entry.load().studies(connection, options)
    if not candidates:
        raise NoDataError(f"{what}: no study has data for it yet. Known: {', '.join(known)}")
    made_for_it = [known for known in entry.studies if known in candidates]
    if made_for_it:
        return made_for_it[0]
    if len(candidates) > 1:
        raise NoDataError(f"{what}: several studies have data for it; choose with --study: {', '.join(candidates)}")
    return candidates[0]
