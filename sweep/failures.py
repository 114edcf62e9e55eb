"""Why trials could not be trained: one file for each shard that failed, kept until its trials are finished.

    failures/<shard>.json   {"format": 1, "trials": [{"trial", "agent", …}, …], "reason", "host", "error", "attempts", "at"}

`at` is a time in UTC.
"""

import contextlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FOLDER = "failures"
_FORMAT = 1

#: Reason → what it means to a user.
REASONS: Mapping[str, str] = {
    "exception": "The training raised an error.",
    "memory": "There was not enough memory.",
    "killed": "The worker's process was killed.",
    "lost": "The worker, or the machine that it ran on, was lost.",
    "store": "The rows could not be written to the store.",
    "timeout": "The training took longer than it may.",
}
EXCEPTION, MEMORY, KILLED, LOST, STORE, TIMEOUT = REASONS


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


def read(store: Path) -> dict[Path, Failure]:
    """Return file → failure for a store, the oldest first. Files that cannot be read are skipped."""
    found = {}
    for file in sorted(store.glob(f"{FOLDER}/*.json")):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            found[file] = _parse(json.loads(file.read_bytes()))
    return dict(sorted(found.items(), key=lambda item: item[1].at))


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
