"""`sweep analyze`: draw a figure of the catalogue from a store and save it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import duckdb

from analysis.database import connect
from analysis.figures.catalogue import Entry, find, list_figures
from analysis.query import short_message
from sweep.messages import UserError, suggestion

__all__ = ["FORMATS", "Result", "analyze", "list_figures"]

FORMATS = ("png", "svg", "pdf", "csv")


@dataclass(frozen=True)
class Result:
    """The files written, and what to tell the user about them."""

    study: str
    files: list[Path]
    notes: list[str]


def analyze(store: Path, figure: str, study: str | None, out: Path, formats: Sequence[str] = ("png",)) -> Result:
    """Draw `figure` (a number such as "7.1") of `study` and write `out`/figure-7.1.png and the other formats.

    Without a study: the figure's own if it has data here, else the only one that has; UserError if
    that leaves a choice.
    """
    entry = find(figure)
    for format in formats:
        if format not in FORMATS:
            raise UserError(f'unknown format "{format}": {suggestion(format, FORMATS)}')
    connection = connect(store)
    try:
        chosen = _choose(connection, entry, study)
        drawing = entry.load().draw(connection, chosen, entry.title)
    except duckdb.Error as error:
        raise UserError(f"{store}: {short_message(error)}") from None
    finally:
        connection.close()
    files = [out / f"figure-{entry.number}.{format}" for format in dict.fromkeys(formats)]
    try:
        out.mkdir(parents=True, exist_ok=True)
        for file in files:
            drawing.save(file, file.suffix.removeprefix("."))
    except OSError as error:
        raise UserError(f"{out}: the figure cannot be written there: {error.strerror}") from None
    return Result(chosen, files, drawing.notes)


def _choose(connection: duckdb.DuckDBPyConnection, entry: Entry, study: str | None) -> str:
    known = [row[0] for row in connection.execute("SELECT DISTINCT study FROM members ORDER BY study").fetchall()]
    if not known:
        raise UserError(f"figure {entry.number}: the store has no study yet")
    if study is not None:
        if study not in known:
            raise UserError(f'unknown study "{study}": {suggestion(study, known)}')
        return study
    candidates = entry.load().studies(connection)
    if not candidates:
        raise UserError(f"figure {entry.number}: no study has data for it yet. Known: {', '.join(known)}")
    if entry.study not in candidates and len(candidates) > 1:
        raise UserError(f"figure {entry.number}: several studies have data for it; choose with --study: {', '.join(candidates)}")
    return entry.study if entry.study in candidates else candidates[0]
