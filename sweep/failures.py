"""Why trials could not be trained: one file for each shard that failed, kept until its trials are finished.

    failures/<shard>.json   {"format": 1, "trials": [{"trial", "agent", …}, …], "reason", "host", "error", "attempts", "at"}

`at` is a time in UTC.
"""

import contextlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sweep.files import write_atomically

FOLDER = "failures"
_FORMAT = 1

#: Reason → what it means to a user.
REASONS: Mapping[str, str] = {
    "exception": "The training raised an error.",
    "memory": "There was not enough memory.",
    "killed": "The worker's process was killed.",
    "lost": "The worker, or the machine that it ran on, was lost.",
    "store": "The rows could not be written to the store.",
    "damaged": "The trial's files were damaged and put aside.",
}
EXCEPTION, MEMORY, KILLED, LOST, STORE, DAMAGED = REASONS


@dataclass(frozen=True)
class Failure:
    """A shard that could not be trained.

    `trials` are its trials' identity columns, as in the table `trials` (of records of old: `trial` only); `reason` is one of
    REASONS, `error` a traceback, `attempts` how often it was tried, `at` an ISO 8601 time, UTC ("" where it is not known).
    """

    trials: tuple[dict[str, Any], ...]
    reason: str
    host: str
    error: str
    attempts: int = 1
    at: str = ""

    def to_json(self) -> bytes:
        """Return the content of its file."""
        return json.dumps({"format": _FORMAT, **vars(self)}, indent=1).encode()


@dataclass(frozen=True)
class _Record:
    """A file's content, None when it cannot be read, while its stamp (modification time in ns, bytes, inode) is this one."""

    stamp: tuple[int, int, int]
    failure: Failure | None
    trials: frozenset[str]


class Records:
    """The records in a store's folder, as they are whenever one asks; a file that is the same as before is not parsed again."""

    def __init__(self, store: Path) -> None:
        self._folder = store / FOLDER
        self._known: dict[str, _Record] = {}

    def read(self) -> list[Failure]:
        """Return the failures, the oldest first. Files that cannot be read are skipped."""
        self._look()
        found = [record.failure for _, record in sorted(self._known.items()) if record.failure is not None]
        return sorted(found, key=lambda failure: failure.at)

    def unfinished(self, finished: Callable[[], set[str]]) -> list[Failure]:
        """Return the failures without trials that are `finished` by now; that is asked only if there are any."""
        recorded = self.read()
        done = finished() if recorded else set()
        left = []
        for failure in recorded:
            trials = tuple(trial for trial in failure.trials if trial["trial"] not in done)
            if trials:
                left.append(replace(failure, trials=trials))
        return left

    def write(self, shard: str, failure: Failure) -> None:
        """Write down why a shard could not be trained, if that can be written."""
        with contextlib.suppress(OSError):
            self._folder.mkdir(exist_ok=True)
            write_atomically(self._folder / f"{shard}.json", failure.to_json())

    def forget(self, new: set[str], finished: Callable[[], set[str]]) -> None:
        """Remove the records with one of the `new` trials whose trials are all `finished`; that is asked only if need be."""
        self._look()
        for name, record in self._known.items():
            if not record.trials.isdisjoint(new) and record.trials <= finished():
                with contextlib.suppress(OSError):
                    (self._folder / name).unlink()

    def _look(self) -> None:
        found = {}
        with contextlib.suppress(OSError), os.scandir(self._folder) as entries:
            for entry in entries:
                if entry.name.endswith(".json"):
                    with contextlib.suppress(OSError):
                        status = entry.stat()
                        stamp = (status.st_mtime_ns, status.st_size, status.st_ino)
                        known = self._known.get(entry.name)
                        found[entry.name] = known if known and known.stamp == stamp else _record(Path(entry.path), stamp)
        self._known = found


def _record(file: Path, stamp: tuple[int, int, int]) -> _Record:
    """Return what a file says. Raises OSError when it cannot be read just now."""
    content = file.read_bytes()
    try:
        failure = _parse(json.loads(content))
    except (ValueError, KeyError, TypeError):
        return _Record(stamp, None, frozenset())
    return _Record(stamp, failure, frozenset(trial["trial"] for trial in failure.trials))


def _parse(content: dict[str, Any]) -> Failure:
    """Return a record's content; one that was written before there was a format has the trials' names only."""
    trials = tuple(known if isinstance(known, dict) else {"trial": known} for known in content["trials"])
    if not all(isinstance(known["trial"], str) for known in trials):
        raise TypeError
    if "format" not in content:
        return Failure(trials, EXCEPTION, str(content["host"]), str(content["error"]))
    return Failure(
        trials,
        str(content["reason"]),
        str(content["host"]),
        str(content["error"]),
        int(content["attempts"]),
        str(content["at"]),
    )
