"""The store's Parquet files as DuckDB tables, with one view for each file in `analysis/sql`.

Parquet is read by pyarrow and handed to DuckDB as Arrow datasets, for three reasons, each measured with DuckDB 2.0:

- DuckDB itself then needs no file at all, and is denied every one. Permission for the store's directory would also
  permit `WITH x AS (COPY … TO 'store/…') SELECT 1` and `EXPLAIN ANALYZE COPY …`, statements of type SELECT and EXPLAIN.
- pyarrow verifies page checksums: a flipped bit is an error, not a wrong number.
- DuckDB prunes by Parquet statistics, which leave NaN out: its own reader finds no row `WHERE isnan(episodic_return)`.

A connection sees the files that lay in the store when it was opened: views are evaluated when they are queried, but a
shard committed later appears only in a new connection, so that everything read through one connection is of one state. So what
is small is read once: the columns of `trials`, `members` and `selections` that were asked for, what studies' grids say of rules
(`grid_rules`), and the views that others read. `early_episodes` are those of shards where `trials` does not say the worst episode
of each: a plan that names `episodes` begins to read all of it, though it may need none.
(DuckDB writes a view out wherever it is named: the choices of a study would be a plan with a hundred scans of the same files.)
"""

import re
import tempfile
import uuid
from collections.abc import Callable, Mapping
from functools import cache, partial
from graphlib import TopologicalSorter
from importlib import resources
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from agents.registry import ALGORITHMS
from analysis import grid_rules
from analysis.on_demand import read_by_column, read_once
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
_LARGE_VIEWS = ("completed_episodes", "learning_curves")  # not kept, whoever reads them


_COLUMNS: dict[tuple[Any, ...], pa.Schema] = {}
"""Columns of views by those of the tables, from which they follow: DuckDB takes half of the time of `connect` to say them."""


def connect(store: str | Path, threads: int | None = None) -> duckdb.DuckDBPyConnection:
    """Return a connection with the store's tables (`schema`) and every view on them.

    `trials` has the failed ones as well: their identity, and NULL elsewhere. The connection can neither read nor write files,
    load extensions or be reconfigured. Raises UserError where there is no store, or a file of it is damaged.
    """
    relations: dict[str, ds.Dataset] = dict(_datasets(Store.open(store)))
    # A sort larger than memory spills into this directory, which DuckDB makes when needed and removes.
    spill = Path(tempfile.gettempdir()) / f"sweep-spill-{uuid.uuid4().hex}"
    config = {
        "autoinstall_known_extensions": False,
        "autoload_known_extensions": False,
        "python_enable_replacements": False,
        "temp_directory": str(spill),
        **({"threads": threads} if threads else {}),
    }
    connection = _opened(config, relations)
    evaluator = cache(partial(_opened, config, {}))
    sources = view_sources()
    tables = tuple((name, dataset.schema) for name, dataset in relations.items())
    kept = set().union(*(_relations(select) for select in sources.values())) - {*_LARGE_VIEWS}
    for name, select in sources.items():
        if name in kept:
            read = {known: relations[known] for known in _relations(select) if known in relations}
            if (name, tables) not in _COLUMNS:
                _COLUMNS[name, tables] = connection.sql(select).limit(0).to_arrow_table().schema
            relations[name] = read_once(_COLUMNS[name, tables], partial(_evaluate, evaluator, select, read))
            connection.register(name, relations[name])
        else:
            connection.execute(f"CREATE VIEW {name} AS {select}")
    connection.execute("SET enable_external_access = false")
    connection.execute("SET lock_configuration = true")
    return connection


def _opened(config: dict[str, Any], relations: Mapping[str, ds.Dataset]) -> duckdb.DuckDBPyConnection:
    connection = duckdb.connect(config=config)
    _register(connection, relations)
    return connection


def _register(connection: duckdb.DuckDBPyConnection, relations: Mapping[str, ds.Dataset]) -> None:
    connection.execute("SET TimeZone = 'UTC'")
    connection.execute("SET enable_progress_bar = false")  # it is written to standard output, between the rows
    for name, dataset in relations.items():
        connection.register(name, dataset)


def _evaluate(evaluator: Callable[[], duckdb.DuckDBPyConnection], select: str, read: Mapping[str, ds.Dataset]) -> pa.Table:
    """Return a view's rows, evaluated on a connection of its own: the one that asks is in the midst of a query."""
    connection = evaluator().cursor()
    try:
        _register(connection, read)
        return connection.sql(select).to_arrow_table()
    finally:
        connection.close()


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
            files = {name: [folder / f"{name}.parquet" for folder in shards] for name in _SHARD_TABLES}
            for name in ("evaluations", "steps"):
                files[name] = [file for file in files[name] if file.exists()]
            footers = {file: _footer(file) for file in files["trials"]}
        except FileNotFoundError:  # compacted since it was listed
            continue
        found = {name: _dataset(files[name], _SHARD_TABLES[name]) for name in ("episodes", "evaluations", "steps")}
        early = [file.with_name("episodes.parquet") for file, footer in footers.items() if _lacks_worst_episodes(footer)]
        found["early_episodes"] = _dataset(early, schema.EPISODES)
        for name, columns in _STUDY_TABLES.items():
            parts = {file: _footer(file) for file in sorted(store.path.glob(f"studies/*/{name}.parquet"))}
            found[name] = read_by_column(_dataset([*parts], _with_columns_of(columns, parts)))
        trials = _dataset([*footers], _with_columns_of(_TRIALS, footers))
        found["trials"] = read_by_column(_with_failed(trials, store.failures()))
        folders = sorted(folder for folder in store.path.glob("studies/*") if folder.is_dir())
        found["grid_rules"] = read_once(grid_rules.COLUMNS, partial(grid_rules.read_rules, folders))
        return found


def _footer(file: Path) -> pq.FileMetaData:
    """Return names and types of a file's columns, and what is known of their values."""
    try:
        return pq.read_metadata(file)
    except FileNotFoundError:
        file.parent.stat()
        raise DamagedError(file, "it is missing") from None
    except (pa.ArrowInvalid, OSError) as error:
        raise _unreadable(file, error) from None


def _unreadable(file: Path, error: Exception) -> UserError:
    return UserError(f"{file}: cannot be read beside the others ({error})")


def _lacks_worst_episodes(trials: pq.FileMetaData) -> bool:
    """Say whether the worst episode of some trial must be looked up: older files of `trials` lack that column."""
    if "worst_episode" not in trials.schema.names:
        return True
    column = trials.schema.names.index("worst_episode")
    known = (trials.row_group(group).column(column).statistics for group in range(trials.num_row_groups))
    return any(statistics is None or statistics.null_count for statistics in known)


def _with_columns_of(columns: pa.Schema, footers: Mapping[Path, pq.FileMetaData]) -> pa.Schema:
    """Return the declared columns, then those of the files: hyperparameters of algorithms that are not registered here."""
    known: set[pa.Schema] = set()
    for file, footer in footers.items():
        try:
            more = footer.schema.to_arrow_schema().remove_metadata()
            columns = columns if more in known else _side_by_side(columns, more)
            known.add(more)
        except (pa.ArrowInvalid, OSError) as error:
            raise _unreadable(file, error) from None
    return columns


def _dataset(files: list[Path], columns: pa.Schema) -> ds.Dataset:
    """Return the files side by side by column name, NULL where a file lacks a column."""
    checked = ds.ParquetFragmentScanOptions(page_checksum_verification=True)
    return ds.dataset(files, schema=columns.remove_metadata(), format=ds.ParquetFileFormat(default_fragment_scan_options=checked))


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
