"""The store's Parquet files as DuckDB tables, with one view for each file in `analysis/sql`.

Parquet is read by pyarrow and handed to DuckDB as Arrow datasets, for three reasons, each measured with DuckDB 2.0:

- DuckDB itself then needs no file at all, and is denied every one. Permission for the store's directory would also
  permit `WITH x AS (COPY … TO 'store/…') SELECT 1` and `EXPLAIN ANALYZE COPY …`, statements of type SELECT and EXPLAIN.
- pyarrow verifies page checksums: a flipped bit is an error, not a wrong number.
- DuckDB prunes by Parquet statistics, which leave NaN out: its own reader finds no row `WHERE isnan(episodic_return)`.

A connection sees the files that lay in the store when it was opened: views are evaluated when they are queried, but a
shard committed later appears only in a new connection, so that everything read through one connection is of one state.
"""

import re
import tempfile
import uuid
from graphlib import TopologicalSorter
from importlib import resources
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from agents.registry import ALGORITHMS
from sweep import schema
from sweep.messages import UserError
from sweep.store import Store

_HYPERS = {name: value for known in ALGORITHMS.values() for name, value in known.hypers().as_dict().items()}
_TABLES = {
    "trials": ("shards/*/trials.parquet", schema.with_hypers(schema.TRIALS, _HYPERS)),
    "episodes": ("shards/*/episodes.parquet", schema.EPISODES),
    "evaluations": ("shards/*/evaluations.parquet", schema.EVALUATIONS),
    "steps": ("shards/*/steps.parquet", schema.STEPS),
    "members": ("studies/*/members.parquet", schema.with_hypers(schema.MEMBERS, _HYPERS)),
}
_OPEN_TABLES = ("trials", "members")  # files may add hyperparameters of algorithms that are not registered here


def connect(store: str | Path, threads: int | None = None) -> duckdb.DuckDBPyConnection:
    """Return a connection with the tables `trials`, `episodes`, `steps`, `evaluations`, `members` and every view on them.

    It can neither read nor write files, load extensions or be reconfigured. UserError where there is no store.
    """
    root = Store.open(store).path
    # A sort larger than memory spills into this directory, which DuckDB makes when needed and removes.
    spill = Path(tempfile.gettempdir()) / f"sweep-spill-{uuid.uuid4().hex}"
    connection = duckdb.connect(
        config={
            "autoinstall_known_extensions": False,
            "autoload_known_extensions": False,
            "python_enable_replacements": False,
            "temp_directory": str(spill),
            **({"threads": threads} if threads else {}),
        }
    )
    connection.execute("SET TimeZone = 'UTC'")
    for name, (pattern, declared) in _TABLES.items():
        connection.register(name, _dataset(sorted(root.glob(pattern)), declared, name in _OPEN_TABLES))
    for name, select in view_sources().items():
        connection.execute(f"CREATE VIEW {name} AS {select}")
    connection.execute("SET enable_external_access = false")
    connection.execute("SET lock_configuration = true")
    return connection


def view_sources() -> dict[str, str]:
    """Return view name → its SELECT from `analysis/sql`, each after the views that it reads."""
    files = (file for file in resources.files("analysis").joinpath("sql").iterdir() if file.name.endswith(".sql"))
    sources = {file.name.removesuffix(".sql"): file.read_text(encoding="utf-8") for file in files}
    reads = {name: sorted(_relations(text) & sources.keys()) for name, text in sorted(sources.items())}
    return {name: sources[name] for name in TopologicalSorter(reads).static_order()}


def _relations(select: str) -> set[str]:
    """Return the names after FROM and JOIN, comments left out."""
    return set(re.findall(r"\b(?:FROM|JOIN)\s+(\w+)", re.sub(r"--.*", "", select)))


def _dataset(files: list[Path], declared: pa.Schema, open: bool) -> ds.Dataset:
    """Return the files side by side by column name: `declared` columns first, NULL where a file lacks one."""
    columns = declared.remove_metadata()
    for file in files if open else ():
        try:
            columns = _side_by_side(columns, pq.read_schema(file).remove_metadata())
        except (pa.ArrowInvalid, OSError) as error:
            raise UserError(f"{file}: cannot be read beside the others ({error})") from None
    checked = ds.ParquetFragmentScanOptions(page_checksum_verification=True)
    return ds.dataset(files, schema=columns, format=ds.ParquetFileFormat(default_fragment_scan_options=checked))


def _side_by_side(columns: pa.Schema, more: pa.Schema) -> pa.Schema:
    """Return the columns of both; a hyperparameter that is a number here and a text there becomes a text."""
    fields = {field.name: field for field in columns}
    for field in more:
        known = fields.get(field.name, field)
        try:
            (merged,) = pa.unify_schemas([pa.schema([known]), pa.schema([field])], promote_options="permissive")
        except pa.ArrowTypeError:
            merged = pa.field(field.name, pa.string())
        fields[field.name] = merged
    return pa.schema(list(fields.values()))
