"""A shard's manifest: which files its folder has, and what was written to them.

    manifest.json   {"format": 1, "files": {name: {"bytes", "rows", "sha256"}}, "replaces": [shards], "sha256"}

It is written beside the files, before the folder becomes visible. A compacted shard names in `replaces` the shards whose rows it
holds: from the moment it is visible, these are not. `sha256`, the last of the keys, is of `files` and `replaces` themselves.
Folders that were written before there were manifests have none.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sweep.files import flushed
from sweep.messages import UserError

NAME = "manifest.json"
#: With these begin the names of the shards that replace others: no other manifest has to be read to know what is visible.
COMPACTED = "c-"
_FORMAT = 1
_ADVICE = "`sweep verify` says what else is, `sweep retry` trains it again"


class DamagedError(UserError):
    """A file of the store is not what was written."""

    def __init__(self, file: Path, what: str) -> None:
        super().__init__(f"{file}: is damaged: {what}; {_ADVICE}")
        self.file, self.what = file, what


@dataclass(frozen=True)
class Entry:
    """What was written to a file: so many bytes, with this SHA-256; a table of so many rows."""

    bytes: int
    rows: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """Name → entry of a shard's files, and the shards that it replaces."""

    files: Mapping[str, Entry]
    replaces: tuple[str, ...] = field(default=())

    def write(self, folder: Path) -> None:
        """Write and flush it to a shard's folder."""
        said = {"files": {name: vars(entry) for name, entry in self.files.items()}, "replaces": list(self.replaces)}
        content = {"format": _FORMAT, **said, "sha256": _digest(said)}
        with flushed(folder / NAME) as sink:
            sink.write(json.dumps(content, indent=1).encode())


def read(folder: Path) -> Manifest | None:
    """Return a shard's manifest, or None where there is none. Raises DamagedError, and FileNotFoundError without the folder."""
    file = folder / NAME
    try:
        content = json.loads(file.read_bytes())
        if content["format"] != _FORMAT:
            raise UserError(f"{file}: is of another format than {_FORMAT}, the one this version reads")
        if content["sha256"] != _digest({key: content[key] for key in ("files", "replaces")}):
            raise DamagedError(file, "its content is not what was written")
        entries = {name: _entry(name, values) for name, values in content["files"].items()}
        return Manifest(entries, tuple(str(name) for name in content["replaces"]))
    except FileNotFoundError:
        folder.stat()
        return None
    except OSError as error:
        raise DamagedError(file, f"cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise DamagedError(file, "cannot be understood") from None


def read_written(folder: Path) -> Manifest:
    """Return a shard's manifest, which it must have. Raises DamagedError, and FileNotFoundError without the folder."""
    manifest = read(folder)
    if manifest is None:
        raise DamagedError(folder / NAME, "it is missing")
    return manifest


def _digest(said: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _entry(name: str, values: dict[str, Any]) -> Entry:
    if Path(name).name != name or not name.endswith(".parquet"):
        raise ValueError(name)
    return Entry(int(values["bytes"]), int(values["rows"]), str(values["sha256"]))


def check_sizes(folder: Path) -> None:
    """Raise DamagedError for a file of a shard that is missing or of another size than was written. Reads the manifest only."""
    manifest = read(folder)
    for name, entry in manifest.files.items() if manifest else ():
        try:
            found = (folder / name).stat().st_size
        except FileNotFoundError:
            folder.stat()
            raise DamagedError(folder / name, f"it is missing, {entry.bytes:,} bytes were written") from None
        except OSError as error:
            raise DamagedError(folder / name, f"cannot be read ({error.strerror})") from None
        if found != entry.bytes:
            raise DamagedError(folder / name, f"{found:,} bytes, {entry.bytes:,} were written")
