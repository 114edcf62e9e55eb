"""`sweep export`: the rows of a study as plain files for other tools: one a table or view, in Parquet or CSV.

Rows stream from the store to the disk in batches, so that memory does not grow with the study. DuckDB itself is denied every file
(`analysis.database`); pyarrow writes.
"""

import contextlib
import json
import os
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq

from analysis.database import connect
from analysis.figures.query_text import listed
from analysis.formats import FORMULA, NUMBER
from analysis.query import short_message
from sweep.files import Sink, flush_folder, flushed, write_atomically
from sweep.messages import UserError, suggestion

FORMATS = ("parquet", "csv")
CONTENTS = "export.json"
_BATCH = 100_000
_MOST_TRIALS = 5_000
"""Trials that one query of the rows of trials names."""

#: Tables and views → the columns that their rows are sorted by; rows of () stay in the order of the store.
#: The tables of single trials hold the trials of the study, of whichever study trained them.
_OF_TRIALS = {"trials": ("trial",), "episodes": (), "evaluations": ()}
_OF_STUDIES = {
    "members": ("study", "stage", "trial"),
    "selections": ("study", "by", "agent", "environment", "for_each"),
    "hyperparameters": ("study", "agent", "environment", "setting", "hyperparameter"),
    "study_trials": ("study", "stage", "trial"),
    "study_progress": ("study", "stage", "agent", "environment"),
    "settings": ("study", "stage", "agent", "environment", "setting"),
    "chosen_runs": ("study", "by", "agent", "environment", "for_each", "trial"),
    "tuned_per_environment": ("study", "agent", "environment", "for_each"),
    "tuned_across_environments": ("study", "agent", "environment", "for_each"),
    "normalizer_constants": ("study", "environment", "normalizer"),
    "normalized_scores": ("study", "stage", "agent", "environment", "setting", "normalizer"),
    "learning_curve_changes": ("study", "by", "agent", "environment", "for_each", "step"),
    "evaluation_curves": ("study", "stage", "agent", "environment", "setting", "step"),
    "sensitivity_lines": ("study", "agent", "environment", "critic_step_size", "entropy_scale"),
}
RELATIONS = (*_OF_TRIALS, *_OF_STUDIES)
STEPS = "steps"


@dataclass(frozen=True)
class Exported:
    """A file that was written: the table or view in it, its rows, its size and its checksum."""

    relation: str
    file: Path
    rows: int
    bytes: int
    sha256: str


def export(
    store: Path,
    studies: Sequence[str],
    out: Path,
    format: str = "parquet",
    steps: bool = False,
    force: bool = False,
    say: Callable[[str], None] = lambda news: None,
) -> list[Exported]:
    """Write the rows of `studies` to `out`/<table or view>.<format>, and to `out`/export.json what the files are.

    Each file appears whole, in place of an earlier one of its name. `steps` adds a row for every environment step; `say` hears
    what is being written. Raises UserError for an unknown format, a folder that has files already (unless `force`), one within
    the store, or one that cannot be written.
    """
    if format not in FORMATS:
        raise UserError(f'unknown format "{format}": {suggestion(format, FORMATS)}')
    _check_folder(store, out, force)
    connection = connect(store)
    try:
        out.mkdir(parents=True, exist_ok=True)
        written = []
        for relation in (*RELATIONS, *((STEPS,) if steps else ())):
            say(relation)
            written.append(_export(connection, relation, studies, out / f"{relation}.{format}"))
        write_atomically(out / CONTENTS, _contents(connection, studies, format, written))
    except duckdb.Error as error:
        raise UserError(f"{store}: {short_message(error)}") from None
    except pa.ArrowException as error:
        raise UserError(f"{store}: a row cannot be exported: {error}") from None
    except OSError as error:
        raise UserError(f"{out}: the rows cannot be written there: {error.strerror or error}") from None
    finally:
        connection.close()
    return written


def _check_folder(store: Path, out: Path, force: bool) -> None:
    if out.resolve().is_relative_to(store.resolve()):
        raise UserError(f"{out}: is in the store, which holds nothing but results: choose a folder outside {store}")
    if out.exists() and not out.is_dir():
        raise UserError(f"{out}: is no folder")
    if out.is_dir() and any(out.iterdir()) and not force:
        raise UserError(f"{out}: has files already: choose an empty folder, or --force to replace those of the same names")


def _queries(connection: duckdb.DuckDBPyConnection, relation: str, studies: Sequence[str]) -> list[str]:
    """Return the SELECTs of a relation's rows of some studies, whose rows follow each other.

    Trials are named one by one: DuckDB hands literals on to the reader of the files, which then skips all others, but it does
    not hand on what a subquery finds.
    """
    order = (_OF_TRIALS | _OF_STUDIES).get(relation, ())
    columns = ", ".join(f'"{name}"' for name in order)
    select, sort = f"SELECT * FROM {relation} WHERE ", f" ORDER BY {columns}" if order else ""
    if relation != STEPS and relation not in _OF_TRIALS:
        return [f"{select}study IN ({listed(studies)}){sort}"]
    found = connection.execute(f"SELECT DISTINCT trial FROM members WHERE study IN ({listed(studies)}) ORDER BY trial").fetchall()
    trials = [row[0] for row in found]
    chunks = [trials[start : start + _MOST_TRIALS] for start in range(0, len(trials), _MOST_TRIALS)] or [[]]
    return [f"{select}trial IN ({listed(chunk)}){sort}" for chunk in chunks]


def _batches(connection: duckdb.DuckDBPyConnection, queries: Sequence[str]) -> pa.RecordBatchReader:
    """Return a reader of the rows of queries, one after the other; all have the columns of the first."""
    first = connection.sql(queries[0]).to_arrow_reader(_BATCH)

    def rows() -> Iterator[pa.RecordBatch]:
        yield from first
        for query in queries[1:]:
            yield from connection.sql(query).to_arrow_reader(_BATCH)

    return pa.RecordBatchReader.from_batches(first.schema, rows())


def _export(connection: duckdb.DuckDBPyConnection, relation: str, studies: Sequence[str], file: Path) -> Exported:
    batches = _batches(connection, _queries(connection, relation, studies))
    write = _write_csv if file.suffix == ".csv" else _write_parquet
    with _in_place_when_whole(file) as sink:
        rows = write(batches, sink)
    return Exported(relation, file, rows, sink.bytes, sink.sha256)


@contextlib.contextmanager
def _in_place_when_whole(file: Path) -> Iterator[Sink]:
    """Open a file beside `file` that takes its place at the end, or is removed when something goes wrong."""
    temporary = file.with_name(f".{file.name}-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    try:
        with flushed(temporary) as sink:
            yield sink
        temporary.replace(file)
        flush_folder(file.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _write_parquet(batches: pa.RecordBatchReader, sink: Sink) -> int:
    rows = 0
    with pq.ParquetWriter(sink, batches.schema, compression="zstd", write_page_checksum=True) as writer:
        for batch in batches:
            writer.write_batch(batch)
            rows += batch.num_rows
    return rows


def _write_csv(batches: pa.RecordBatchReader, sink: Sink) -> int:
    """Write as `sweep sql --format csv` does: NULL is empty, lists are JSON, texts that look like formulas get an apostrophe."""
    columns = pa.schema([pa.field(field.name, _csv_type(field.type)) for field in batches.schema])
    rows = 0
    with pyarrow.csv.CSVWriter(sink, columns, write_options=pyarrow.csv.WriteOptions(quoting_style="needed")) as writer:
        for batch in batches:
            arrays = [_csv_column(column) for column in batch.columns]
            writer.write_batch(pa.record_batch(arrays, schema=columns))
            rows += batch.num_rows
    return rows


def _csv_type(type: pa.DataType) -> pa.DataType:
    is_plain = pa.types.is_integer(type) or pa.types.is_floating(type) or pa.types.is_boolean(type)
    return type if is_plain else pa.string()


def _csv_column(column: pa.Array) -> pa.Array:
    if _csv_type(column.type) == column.type and not pa.types.is_string(column.type):
        return column
    if pa.types.is_nested(column.type):
        return pa.array([None if value is None else json.dumps(value) for value in column.to_pylist()], pa.string())
    if pa.types.is_timestamp(column.type):
        texts = pa.array([None if value is None else value.isoformat() for value in column.to_pylist()], pa.string())
    else:
        texts = column.cast(pa.string())
    starts = pc.match_substring_regex(texts, f"^{FORMULA}")
    is_formula = pc.and_not(starts, pc.match_substring_regex(texts, f"^({NUMBER})$"))
    return pc.if_else(is_formula, pc.binary_join_element_wise("'", texts, ""), texts)


def _contents(connection: duckdb.DuckDBPyConnection, studies: Sequence[str], format: str, written: Sequence[Exported]) -> bytes:
    """Return JSON: the studies, and of each file its rows, columns with their types, size and checksum."""
    files: list[dict[str, Any]] = []
    for one in written:
        columns = connection.execute(f"DESCRIBE {one.relation}").fetchall()
        files.append(
            {
                "file": one.file.name,
                "rows": one.rows,
                "bytes": one.bytes,
                "sha256": one.sha256,
                "columns": {name: type for name, type, *_ in columns},
            }
        )
    return (json.dumps({"studies": list(studies), "format": format, "files": files}, indent=1) + "\n").encode()
