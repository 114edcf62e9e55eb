"""Tables that are made when a query first asks for them, handed to DuckDB as Arrow datasets, and kept."""

import threading
from collections.abc import Callable
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds

_READ_TOGETHER = {  # what every score needs, in one pass over the files
    "trial", "status", "episode_mean", "step_mean", "final_mean", "best_episode", "worst_episode",
    "study", "stage", "setting", "agent", "environment", "seed",
}  # fmt: skip


class OnDemand(ds.FileSystemDataset):
    """What DuckDB takes for a dataset: it asks for a scanner of some columns, and `read` returns a table with them at least."""

    def __init__(self, columns: pa.Schema, read: Callable[[list[str]], pa.Table]) -> None:
        """Take the names and types of all columns."""
        super().__init__([], columns, ds.ParquetFileFormat())
        self._read = read
        self._lock = threading.Lock()

    def scanner(self, columns: list[str] | None = None, **how: Any) -> ds.Scanner:
        """Return a scanner of the table; DuckDB passes names of columns, and a filter."""
        wanted = self.schema.names if columns is None else columns
        named = [name for name in self.schema.names if name in str(how.get("filter"))]
        with self._lock:
            table = self._read([*wanted, *named])
        return ds.dataset(table).scanner(columns=wanted, **how)


def read_once(columns: pa.Schema, make: Callable[[], pa.Table]) -> OnDemand:
    """Return a dataset of the table that `make` returns, which is called at the first query, if at all."""
    made: list[pa.Table] = []

    def read(_: list[str]) -> pa.Table:
        if not made:
            made.append(make())
        return made[0]

    return OnDemand(columns, read)


def read_by_column(dataset: ds.Dataset) -> OnDemand:
    """Return a dataset of which the columns that were asked for stay in memory."""
    known: dict[str, pa.ChunkedArray] = {}

    def read(columns: list[str]) -> pa.Table:
        missing = [name for name in dict.fromkeys(columns) if name not in known]
        if missing:
            missing += [name for name in dataset.schema.names if name in _READ_TOGETHER - {*missing, *known}]
            known.update(zip(missing, dataset.to_table(columns=missing).columns, strict=True))
        return pa.table({name: known[name] for name in dict.fromkeys(columns)})

    return OnDemand(dataset.schema, read)
