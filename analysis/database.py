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
from typing import Any

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from agents.registry import ALGORITHMS
from sweep import manifest, schema
from sweep.failures import Failure
from sweep.manifest import DamagedError
from sweep.messages import UserError
from sweep.store import Store

_HYPERS = {name: value for known in ALGORITHMS.values() for name, value in known.hypers().as_dict().items()}
_TRIALS = schema.with_hypers(schema.TRIALS, _HYPERS)
_SHARD_TABLES = {
    "trials": _TRIALS,
    "episodes": schema.EPISODES,
    "evaluations": schema.EVALUATIONS,
    "steps": schema.STEPS,
}
_STUDY_TABLES = {
    "members": schema.with_hypers(schema.MEMBERS, _HYPERS),
    "selections": schema.with_hypers(schema.SELECTIONS, _HYPERS, after="setting"),
}
_OPEN_TABLES = ("trials", "members", "selections")  # files may add hyperparameters of algorithms that are not registered here


def connect(store: str | Path, threads: int | None = None) -> duckdb.DuckDBPyConnection:
    """Return a connection with the store's tables (`schema`) and every view on them.

    `trials` has the failed ones as well: their identity, and NULL elsewhere. The connection can neither read nor write files,
    load extensions or be reconfigured. Raises UserError where there is no store, or a file of it is damaged.
    """
    datasets = _datasets(Store.open(store))
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
    for name, dataset in datasets.items():
        connection.register(name, dataset)
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


def _datasets(store: Store) -> dict[str, ds.Dataset]:
    """Return table → what it reads. Files are of their full size, or it is said which is not."""
    while True:
        try:
            shards = store.shards()
            for folder in shards:
                manifest.check_sizes(folder)
            found = {name: _dataset([folder / f"{name}.parquet" for folder in shards], name) for name in _SHARD_TABLES}
        except FileNotFoundError:  # compacted since it was listed
            continue
        for name in _STUDY_TABLES:
            found[name] = _dataset(sorted(store.path.glob(f"studies/*/{name}.parquet")), name)
        found["trials"] = _with_failed(found["trials"], store.failures())
        return found


def _dataset(files: list[Path], table: str) -> ds.Dataset:
    """Return the files side by side by column name: declared columns first, NULL where a file lacks one."""
    files = [file for file in files if file.exists()] if table == "evaluations" else files
    columns = (_SHARD_TABLES | _STUDY_TABLES)[table].remove_metadata()
    known: set[pa.Schema] = set()
    for file in files if table in _OPEN_TABLES else ():
        try:
            more = pq.read_schema(file).remove_metadata()
            columns = columns if more in known else _side_by_side(columns, more)
            known.add(more)
        except FileNotFoundError:
            file.parent.stat()
            raise DamagedError(file, "it is missing") from None
        except (pa.ArrowInvalid, OSError) as error:
            raise UserError(f"{file}: cannot be read beside the others ({error})") from None
    checked = ds.ParquetFragmentScanOptions(page_checksum_verification=True)
    return ds.dataset(files, schema=columns, format=ds.ParquetFileFormat(default_fragment_scan_options=checked))


def _with_failed(trials: ds.Dataset, failures: list[Failure]) -> ds.Dataset:
    """Return the table with a row for each failed trial: what is known of it before it is trained."""
    rows = {trial["trial"]: trial for failure in failures for trial in failure.trials}
    if not rows:
        return trials
    columns = trials.schema
    for row in rows.values():
        columns = _side_by_side(columns, pa.schema([schema.hyper_field(*item) for item in row.items() if item[1] is not None]))
    values = {field.name: [row.get(field.name) for row in rows.values()] for field in columns}
    values["status"] = ["failed"] * len(rows)
    failed = {name: _column(values[name], columns.field(name).type) for name in columns.names}
    return ds.dataset([trials.replace_schema(columns), ds.dataset(pa.table(failed, columns))])


def _column(values: list[Any], type: pa.DataType) -> pa.Array:
    """Return a column; a number where others have texts is a text."""
    is_text = pa.types.is_string(type)
    return pa.array([str(value) if is_text and value is not None else value for value in values], type)


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
