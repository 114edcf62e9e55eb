"""A store of results: a folder that holds each finished trial exactly once.

    sweep-store.json                                marks the folder as a store
    shards/<shard>/{trials,episodes,steps}.parquet  trials that were trained together: visible whole or not at all;
                                                    with evaluations.parquet where there are evaluation episodes
    studies/<study>/{grid.toml,members.parquet}     what a study needs, finished or not
    failures/<shard>.json                           the last error of a shard that could not be trained
    .staging/  .progress/  .lock                    work under way; never read as results

A shard is written and flushed to disk in `.staging`, then its folder is renamed into place: a rename is atomic, and it fails when
the name is taken. Under the lock, trials that are in the store by then are left out, so that two launches at once, or a
worker that was given up for dead, cannot put a trial there twice. What is finished is read off the files themselves.
"""

import contextlib
import fcntl
import json
import os
import shutil
import socket
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq

from sweep import schema
from sweep.messages import UserError
from sweep.tables import ShardTables

_MARKER = "sweep-store.json"
_FORMAT = 1
_STALE_SECONDS = 24 * 3600
_ROW_GROUP_ROWS = 100_000
_WRITING: dict[str, Any] = {"compression": "zstd", "write_page_checksum": True, "store_schema": False}


class Store:
    """The store in a folder. `open` one that exists, or `create` it."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._read_shards: dict[str, set[str]] = {}

    @classmethod
    def open(cls, path: str | Path) -> "Store":
        """Return the store in a folder. Raises UserError when there is none, or it is of another format."""
        store = cls(path)
        if not store.path.exists():
            raise UserError(f"{path}: there is no store here; `sweep launch` makes one, `--store DIR` names another")
        try:
            marker = json.loads((store.path / _MARKER).read_text("utf-8"))
        except (OSError, ValueError):
            raise UserError(f"{path}: is not a store: it has no readable {_MARKER}") from None
        if not isinstance(marker, dict) or marker.get("format") != _FORMAT:
            raise UserError(f"{path}: is a store of another format than {_FORMAT}, the one this version reads")
        return store

    @classmethod
    def create(cls, path: str | Path) -> "Store":
        """Return the store in a folder, made there if the folder is missing or empty. Raises UserError when it is neither."""
        folder = Path(path)
        try:
            if folder.exists() and (not folder.is_dir() or any(not _is_beginning(file) for file in folder.iterdir())):
                return cls.open(path)
            folder.mkdir(parents=True, exist_ok=True)
            _write_atomically(folder / _MARKER, json.dumps({"format": _FORMAT}).encode())
        except OSError as error:
            raise UserError(f"{path}: a store cannot be made here: {error.strerror}") from None
        return cls(folder)

    def finished_trials(self) -> set[str]:
        """Return the trials whose rows are in the store. Raises UserError naming a file that cannot be read."""
        for file in self.path.glob("shards/*/trials.parquet"):
            if file.parent.name not in self._read_shards:  # a committed shard never changes
                self._read_shards[file.parent.name] = _trials_in(file)
        return set().union(*self._read_shards.values())

    def commit(self, shard: str, tables: ShardTables) -> int:
        """Make a shard's rows visible, all at once; return how many trials were new."""
        staging = self.path / ".staging" / f"{shard}-{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        staging.mkdir(parents=True)
        try:
            _write_tables(staging, tables)
            with self._locked():
                present = self.finished_trials() & set(tables.trials["trial"].to_pylist())
                if present:
                    tables = tables.without(present)
                    _write_tables(staging, tables)
                if tables.trials.num_rows:
                    final = self.path / "shards" / shard
                    final.parent.mkdir(exist_ok=True)
                    staging.rename(final)
                    _flush_folder(final.parent)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
        self._forget_failures(set(tables.trials["trial"].to_pylist()))
        return tables.trials.num_rows

    def study_trials(self, name: str) -> set[str]:
        """Return the trials that a study needed when it was written last."""
        file = self.path / "studies" / name / "members.parquet"
        return _trials_in(file) if file.exists() else set()

    def write_study(self, name: str, grid: str, members: pa.Table) -> None:
        """Write down what a study needs; nothing is touched when that is there already. Raises UserError if it cannot."""
        folder = self.path / "studies" / name
        sink = pa.BufferOutputStream()
        pq.write_table(members, sink, compression="zstd")
        contents = {folder / "grid.toml": grid.encode(), folder / "members.parquet": sink.getvalue().to_pybytes()}
        for file, content in contents.items():
            try:
                if not file.exists() or file.read_bytes() != content:
                    folder.mkdir(parents=True, exist_ok=True)
                    _write_atomically(file, content)
            except OSError as error:
                raise UserError(f"{self.path}: the study cannot be written to this store: {error.strerror}") from None

    def record_failure(self, shard: str, trials: list[str], host: str, error: str) -> None:
        """Write down why a shard could not be trained, if that can be written."""
        file = self.path / "failures" / f"{shard}.json"
        with contextlib.suppress(OSError):
            file.parent.mkdir(exist_ok=True)
            _write_atomically(file, json.dumps({"trials": trials, "host": host, "error": error}, indent=1).encode())

    def _forget_failures(self, finished: set[str]) -> None:
        """Drop the records of failures whose trials have been trained since."""
        for file in self.path.glob("failures/*.json"):
            with contextlib.suppress(OSError, ValueError):
                trials = set(json.loads(file.read_text("utf-8"))["trials"])
                if trials & finished and trials <= self.finished_trials() | finished:
                    file.unlink()

    def clean_up(self) -> None:
        """Remove what killed workers left behind a day ago or earlier; it was never visible."""
        for folder in self.path.glob(".staging/*"):
            with contextlib.suppress(OSError):
                if time.time() - folder.stat().st_mtime > _STALE_SECONDS:
                    shutil.rmtree(folder, ignore_errors=True)

    def report_progress(self, shard: str, agent_steps: int) -> None:
        """Write down how many agent-steps of a shard are done, for whoever shows progress; not kept, and no harm if it fails."""
        file = self.path / ".progress" / shard
        with contextlib.suppress(OSError):
            file.parent.mkdir(exist_ok=True)
            _write_atomically(file, str(agent_steps).encode(), flush=False)

    def progress(self, shards: list[str]) -> int:
        """Return the agent-steps reported for shards that are under way."""
        done = 0
        for shard in shards:
            with contextlib.suppress(OSError, ValueError):
                done += int((self.path / ".progress" / shard).read_text())
        return done

    def clear_progress(self, shard: str) -> None:
        """Forget the progress of a shard."""
        with contextlib.suppress(OSError):
            (self.path / ".progress" / shard).unlink(missing_ok=True)

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        with open(self.path / ".lock", "a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield


def _is_beginning(file: Path) -> bool:
    """A marker half written: another launch makes this store just now, or was killed while it did."""
    return file.name.startswith(f".{_MARKER}-")


def _trials_in(file: Path) -> set[str]:
    try:
        return set(pq.read_table(file, columns=["trial"], partitioning=None)["trial"].to_pylist())
    except (OSError, pa.ArrowException) as error:
        raise UserError(f"{file}: is damaged and cannot be read: {error}") from None


def _write_tables(folder: Path, tables: ShardTables) -> None:
    """Write and flush the files. Of `steps`, one row group at a time is in memory, however long the trials.

    `steps` costs about as much as the episodes because the step numbers are stored as differences and the returns by
    dictionary and run length: plain encodings are a hundred times larger.
    """
    _write_table(folder / "trials.parquet", tables.trials)
    _write_table(folder / "episodes.parquet", tables.episodes)
    if tables.evaluations is not None:
        _write_table(folder / "evaluations.parquet", tables.evaluations)
    encodings = {"use_dictionary": ["trial", "episodic_return"], "column_encoding": {"step": "DELTA_BINARY_PACKED"}}
    with _flushed(folder / "steps.parquet") as sink, pq.ParquetWriter(sink, schema.STEPS, **_WRITING, **encodings) as writer:
        for batch in tables.steps_in_blocks(_ROW_GROUP_ROWS):
            writer.write_batch(batch)
    _flush_folder(folder)


def _write_table(file: Path, table: pa.Table) -> None:
    with _flushed(file) as sink:
        pq.write_table(table, sink, **_WRITING)


@contextlib.contextmanager
def _flushed(file: Path) -> Iterator[IO[bytes]]:
    """Open a file to write to; what was written is on disk afterwards."""
    with open(file, "wb") as sink:
        yield sink
        sink.flush()
        os.fsync(sink.fileno())


def _write_atomically(file: Path, content: bytes, flush: bool = True) -> None:
    temporary = file.with_name(f".{file.name}-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    with open(temporary, "wb") as sink:
        sink.write(content)
        if flush:
            sink.flush()
            os.fsync(sink.fileno())
    temporary.replace(file)
    if flush:
        _flush_folder(file.parent)


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
