"""A store of results: a folder that holds each finished trial exactly once.

    sweep-store.json                                marks the folder as a store
    shards/<shard>/{trials,episodes,steps}.parquet  trials that were trained together: visible whole or not at all; with
                                                    evaluations.parquet where there are evaluation episodes; a shard may do
                                                    without steps.parquet, which is the episodes spelled out
    shards/<shard>/manifest.json                    sizes, rows and checksums of these files (`sweep.manifest`)
    studies/<study>/  failures/<shard>.json         what a study needs (`sweep.study_files`); what failed (`sweep.failures`)
    .staging/  .progress/  .quarantine/  .lock      work under way, and damaged shards; never read as results

A shard is written and flushed to disk in `.staging`, then its folder is renamed into place: a rename is atomic, and it fails when
the name is taken. Under the lock, trials that are in the store by then are left out, so that two launches at once, or a
worker that was given up for dead, cannot put a trial there twice. What is finished is read off the files themselves.
"""

import contextlib
import datetime
import fcntl
import json
import os
import shutil
import socket
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from sweep import failures, manifest, shard_files, study_files
from sweep.failures import Failure
from sweep.files import UnwritableError, flush_folder, flushed, folders_in, write_atomically
from sweep.messages import UserError, suggestion
from sweep.tables import ShardTables, identity_columns

if TYPE_CHECKING:
    from sweep.trials import Trial

_MARKER = "sweep-store.json"
_FORMAT = 1
STALE_SECONDS = 24 * 3600
_Write = Callable[[Path], None]
_Read = Callable[[], ShardTables]


class Store:
    """The store in a folder. `open` one that exists, or `create` it."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._failures = failures.Records(self.path)
        self._trials: dict[tuple[str, int], set[str]] = {}
        self._checked: set[tuple[str, int]] = set()
        self._finished_in: tuple[frozenset[tuple[str, int]], set[str]] = (frozenset(), set())

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
    def open_if_any(cls, path: str | Path) -> "Store | None":
        """Return the store in a folder, None where the folder is missing or empty. Raises UserError when it is something else."""
        folder = Path(path)
        is_empty = not folder.exists() or (folder.is_dir() and all(_is_beginning(file) for file in folder.iterdir()))
        return None if is_empty else cls.open(path)

    @classmethod
    def create(cls, path: str | Path) -> "Store":
        """Return the store in a folder, made there if the folder is missing or empty. Raises UserError when it is neither."""
        folder = Path(path)
        try:
            there = cls.open_if_any(path)
            if there is not None:
                return there
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(folder / _MARKER, json.dumps({"format": _FORMAT}).encode())
        except OSError as error:
            raise UserError(f"{path}: a store cannot be made here: {error.strerror}") from None
        return cls(folder)

    def shards(self, *, lenient: bool = False) -> list[Path]:
        """Return the folders of the shards, by name, without those that a compacted one replaces.

        Raises DamagedError when a compacted shard does not say which it replaces; `lenient` takes it to replace none. A folder in
        the list may be gone by the time it is read, when the store is compacted meanwhile.
        """
        return [self.path / "shards" / name for name, _ in self._visible(lenient)]

    def superseded(self) -> list[Path]:
        """Return the folders that a compacted shard replaces and that are there still, of a compaction that was killed."""
        return sorted({folder for replaced in self.replacements().values() for folder in replaced})

    def replacements(self) -> dict[Path, list[Path]]:
        """Return compacted shard → the folders that it replaces and that are there still, by name; none of those without any."""
        shards = self.path / "shards"
        found, replaces = manifest.listed(shards, lenient=True)
        there = {name: [shards / known for known, _ in found if known in replaces[name]] for name in sorted(replaces)}
        return {shards / name: folders for name, folders in there.items() if folders}

    def _visible(self, lenient: bool) -> list[tuple[str, int]]:
        """Return names and inodes. A listing that a compaction falls into may miss the old and the new: it must repeat itself."""
        known = None
        while True:
            with contextlib.suppress(FileNotFoundError):  # a compacted shard that is compacted again just now
                found, replaces = manifest.listed(self.path / "shards", lenient)
                if found == known:
                    replaced = set().union(*replaces.values())
                    return [key for key in found if key[0] not in replaced]
                known = found

    def finished_trials(self) -> set[str]:
        """Return the trials whose rows are in the store.

        Raises DamagedError naming a file that cannot be read, is missing, or is not of the size that was written.
        """
        return set(self._finished(check=True))

    def _finished(self, check: bool) -> set[str]:
        """Without `check` a shard has only to say which trials it holds: nothing else in it is a reason not to commit."""
        while True:
            visible = self._visible(lenient=not check)
            try:
                for key in visible:  # what a folder holds never changes
                    folder = self.path / "shards" / key[0]
                    if check and key not in self._checked:
                        self._trials[key] = set(manifest.checked_trials(folder) or shard_files.trials_in(folder))
                        self._checked.add(key)
                    elif key not in self._trials:
                        self._trials[key] = set(manifest.trials_said(folder) or shard_files.trials_in(folder))
            except FileNotFoundError:  # compacted since it was listed
                continue
            now = frozenset(visible)
            before, trials = self._finished_in
            if not before <= now:
                before, trials = frozenset(), set()
            trials.update(*(self._trials[key] for key in now - before))
            self._finished_in = now, trials
            return trials

    def commit(self, shard: str, tables: ShardTables) -> int:
        """Make a shard's rows visible, all at once; return how many trials were new.

        Raises UnwritableError, a UserError and an OSError, when the store cannot be written to; nothing is visible then, or all.
        """
        names = tables.trials["trial"].to_pylist()
        return self._commit(shard, names, lambda to: shard_files.write(to, tables), lambda: tables)

    def commit_copy(self, shard: str, source: Path, with_steps: bool = True) -> int:
        """Commit a copy of the folder of another store's shard; of trials that are here, the rows are left out.

        Returns how many trials were new. Raises as `commit` does, and DamagedError for a file that is not what was written there.
        """
        trials, copy = shard_files.trials_in(source), partial(shard_files.copy, source, with_steps=with_steps)
        return self._commit(shard, trials, copy, partial(shard_files.read, source), with_steps)

    def _commit(self, shard: str, trials: Iterable[str], write: _Write, read: _Read, with_steps: bool = True) -> int:
        new = set(trials)
        with self.staged(shard) as staging:
            write(staging)
            with self.locked():
                present = self._finished(check=False) & new
                new -= present
                if present and new:
                    shard_files.write(staging, read().without(present), with_steps=with_steps)
                if new:
                    self.publish(staging, self.free_name(shard))
        with contextlib.suppress(UserError):
            self._failures.forget(new, lambda: self._finished(check=False))
        return len(new)

    def free_name(self, shard: str) -> str:
        """Return the name, or where it is taken one that begins with it: the rest of a shard may come after the first part."""
        found, replaces = manifest.listed(self.path / "shards", lenient=True)
        is_taken = shard in {name for name, _ in found}.union(*replaces.values())
        return f"{shard}-{uuid.uuid4().hex[:8]}" if is_taken else shard

    @contextlib.contextmanager
    def staged(self, shard: str) -> Iterator[Path]:
        """Make a folder to write a shard's files to. It is removed afterwards, unless `publish` gave it its place.

        An OSError in the block, of whatever is written, becomes an UnwritableError.
        """
        folder = self.path / ".staging" / f"{shard}-{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        try:
            folder.mkdir(parents=True)
            yield folder
        except UserError:
            raise
        except OSError as error:
            raise UnwritableError(f"{self.path}: cannot be written to: {error.strerror or error}", error.errno) from error
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def publish(self, staging: Path, shard: str) -> None:
        """Make a staged folder visible as a shard of a name that is free. To be called under the lock."""
        final = self.path / "shards" / shard
        if not final.parent.exists():
            final.parent.mkdir()
            flush_folder(self.path)
        staging.rename(final)
        flush_folder(final.parent)

    def discard(self, shards: Iterable[Path]) -> None:
        """Remove shards that others replace: each disappears at once, whatever happens while its files are removed.

        Raises ValueError for a folder that is no shard's.
        """
        for folder in shards:
            if not self._is_place(folder):
                raise ValueError(f"{folder}: is no shard of {self.path}")
            with self.staged(folder.name) as grave, contextlib.suppress(FileNotFoundError):  # another compaction was faster
                folder.rename(grave / folder.name)

    def quarantine(self, shard: str) -> Path:
        """Move a shard's folder to `.quarantine`, and return where it is now: its trials are missing then.

        Raises UserError when there is no such shard, UnwritableError when it cannot be moved.
        """
        folder = self.path / "shards" / shard
        moment = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%S")
        target = self.path / ".quarantine" / f"{shard}-{moment}-{uuid.uuid4().hex[:4]}"
        if not self._is_place(folder) or not folder.is_dir():
            raise UserError(f'{self.path}: there is no shard "{shard}"')
        try:
            target.parent.mkdir(exist_ok=True)
            with self.locked():
                folder.rename(target)
                flush_folder(target.parent)
                flush_folder(folder.parent)
        except OSError as error:
            raise UnwritableError(f"{folder}: cannot be moved: {error.strerror or error}", error.errno) from error
        return target

    def _is_place(self, folder: Path) -> bool:
        """Whether this is where a shard may lie: whatever a name says, nothing outside `shards` is moved or removed."""
        return folder.parent == self.path / "shards" and manifest.is_shard_name(folder.name)

    def check_writable(self) -> None:
        """Raise UnwritableError when nothing could be committed: better before training than after."""
        with self.staged("check") as folder, flushed(folder / "file") as sink:
            sink.write(b"0")

    def studies(self) -> list[str]:
        """Return the names of the studies that were written to the store."""
        return [name for name, _ in folders_in(self.path / "studies")]

    def study_source(self, name: str) -> tuple[str, tuple[str, ...]]:
        """Return a study's grid, as its file's text, and what `--set` changed of it. Raises UserError for an unknown study."""
        try:
            return study_files.source(self.path / "studies" / name)
        except FileNotFoundError:
            known = suggestion(name, self.studies()) if self.studies() else "it has no study yet"
            raise UserError(f'{self.path}: there is no study "{name}" in this store; {known}') from None

    def study_trials(self, name: str, stage: str | None = None) -> set[str]:
        """Return the trials that a study needed when it was written last, in one stage or in all."""
        return study_files.trials(self.path / "studies" / name, stage)

    def write_study(self, name: str, grid: str, members: pa.Table, overrides: Sequence[str] = ()) -> None:
        """Write down what a study needs: its grid, what `--set` changed of it, its trials. Raises UnwritableError if it cannot.

        Nothing is touched when that is there already.
        """
        study_files.write(self.path / "studies" / name, grid, members, overrides)

    def record_failure(
        self, shard: str, trials: Sequence["Trial"], reason: str, host: str, error: str, attempts: int = 1
    ) -> None:
        """Write down why a shard could not be trained (`failures.REASONS`), if that can be written."""
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        failure = Failure(tuple(identity_columns(trial) for trial in trials), reason, host, error, attempts, now)
        self._failures.write(shard, failure)

    def failures(self) -> list[Failure]:
        """Return what could not be trained, the oldest first, without trials that are finished by now."""
        return self._failures.unfinished(lambda: self._finished(check=False))

    def clean_up(self) -> None:
        """Remove what killed workers left behind a day ago or earlier; it was never visible."""
        for folder in self.path.glob(".staging/*"):
            with contextlib.suppress(OSError):
                if is_stale(folder):
                    shutil.rmtree(folder, ignore_errors=True)

    def report_progress(self, shard: str, agent_steps: int) -> None:
        """Write down how many agent-steps of a shard are done, for whoever shows progress; not kept, and no harm if it fails."""
        file = self.path / ".progress" / shard
        with contextlib.suppress(OSError):
            file.parent.mkdir(exist_ok=True)
            write_atomically(file, str(agent_steps).encode(), flush=False)

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
    def locked(self) -> Iterator[None]:
        """Hold the store's lock: nobody else makes shards visible, or moves them away."""
        with open(self.path / ".lock", "a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield


def is_stale(file: Path, seconds: float = STALE_SECONDS) -> bool:
    """Return whether a file or folder is so old that nobody works on it any longer. Raises OSError."""
    return time.time() - file.stat().st_mtime > seconds


def _is_beginning(file: Path) -> bool:
    """A marker half written: another launch makes this store just now, or was killed while it did."""
    return file.name.startswith(f".{_MARKER}-")
