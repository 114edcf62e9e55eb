"""The Parquet files of a shard: how they are encoded, written and read again."""

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sweep import files, manifest, schema
from sweep.files import Sink, flush_folder, flushed
from sweep.manifest import DamagedError, Entry, Manifest
from sweep.tables import ShardTables

TRIALS, EPISODES, EVALUATIONS, STEPS = "trials.parquet", "episodes.parquet", "evaluations.parquet", "steps.parquet"
_ROW_GROUP_ROWS = 100_000
_WRITING: dict[str, Any] = {"compression": "zstd", "write_page_checksum": True, "store_schema": False}
_UNREADABLE = (OSError, ValueError, pa.ArrowException)


def write(folder: Path, tables: ShardTables, replaces: tuple[str, ...] = (), with_steps: bool = True) -> None:
    """Write and flush a shard's files and their manifest. Of `steps`, one row group at a time is in memory.

    `steps` is the episodes spelled out, and may be left out. It costs about as much as they do because step numbers are stored as
    differences and returns by dictionary and run length: plain encodings are a hundred times larger.
    """
    entries = {
        TRIALS: _write_table(folder / TRIALS, tables.trials),
        EPISODES: _write_table(folder / EPISODES, tables.episodes),
    }
    if tables.evaluations is not None:
        entries[EVALUATIONS] = _write_table(folder / EVALUATIONS, tables.evaluations)
    if with_steps:
        entries[STEPS] = _write_steps(folder / STEPS, tables)
    Manifest(entries, replaces).write(folder)
    flush_folder(folder)


def _write_steps(file: Path, tables: ShardTables) -> Entry:
    encodings = {"use_dictionary": ["trial", "episodic_return"], "column_encoding": {"step": "DELTA_BINARY_PACKED"}}
    rows = 0
    with flushed(file) as sink, pq.ParquetWriter(sink, schema.STEPS, **_WRITING, **encodings) as writer:
        for batch in tables.steps_in_blocks(_ROW_GROUP_ROWS):
            writer.write_batch(batch)
            rows += batch.num_rows
    return _entry(sink, rows)


def _write_table(file: Path, table: pa.Table) -> Entry:
    with flushed(file) as sink:
        pq.write_table(table, sink, **_WRITING)
    return _entry(sink, table.num_rows)


def _entry(sink: Sink, rows: int) -> Entry:
    return Entry(sink.bytes, rows, sink.sha256)


def read(folder: Path) -> ShardTables:
    """Return the tables of a shard. Raises DamagedError for a file that cannot be read, FileNotFoundError without the folder."""
    evaluations = read_table(folder / EVALUATIONS) if (folder / EVALUATIONS).exists() else None
    episodes = read_table(folder / EPISODES)
    # `ShardTables.steps_in_blocks` wants the names in the order of their rows
    trial = episodes["trial"].cast(pa.string()).combine_chunks().dictionary_encode()
    position = episodes.schema.get_field_index("trial")
    return ShardTables(read_table(folder / TRIALS), episodes.set_column(position, "trial", trial), evaluations)


def read_table(file: Path, columns: list[str] | None = None) -> pa.Table:
    """Return (columns of) a Parquet file, texts as dictionaries where its schema in the store says so. Raises as `read` does."""
    declared = {EPISODES: schema.EPISODES, EVALUATIONS: schema.EVALUATIONS}.get(file.name)
    names = [field.name for field in declared or () if pa.types.is_dictionary(field.type)]
    try:
        with pq.ParquetFile(file, read_dictionary=names, page_checksum_verification=True) as opened:
            missing = [name for name in columns or () if name not in opened.schema_arrow.names]
            if missing:
                raise DamagedError(file, f"has no column {', '.join(missing)}")
            table = opened.read(columns=columns, use_threads=False)
        return table.unify_dictionaries() if names else table
    except FileNotFoundError:
        file.parent.stat()
        raise DamagedError(file, "it is missing") from None
    except _UNREADABLE as error:
        raise DamagedError(file, f"cannot be read ({_first_line(error)})") from None


def copy(source: Path, target: Path, with_steps: bool = True) -> None:
    """Copy a shard's files, and write and flush their manifest. Raises DamagedError for one that is not what was written."""
    known = manifest.read(source)
    entries = {}
    for name in known.files if known else sorted(file.name for file in source.glob("*.parquet")):
        if name == STEPS and not with_steps:
            continue
        try:
            sink = files.copy(source / name, target / name)
        except FileNotFoundError:
            raise DamagedError(source / name, "it is missing") from None
        expected = known.files[name] if known else Entry(sink.bytes, rows_in(target / name), sink.sha256)
        if (sink.bytes, sink.sha256) != (expected.bytes, expected.sha256):
            raise DamagedError(source / name, "its content is not what was written")
        entries[name] = expected
    Manifest(entries).write(target)
    flush_folder(target)


def rows_in(file: Path) -> int:
    """Return how many rows a Parquet file says that it has. Raises DamagedError."""
    try:
        return pq.read_metadata(file).num_rows
    except _UNREADABLE as error:
        raise DamagedError(file, f"cannot be read ({_first_line(error)})") from None


def trials_in(folder: Path) -> set[str]:
    """Return the trials of a shard. Raises as `read` does."""
    return set(read_table(folder / TRIALS, ["trial"])["trial"].to_pylist())


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0]
