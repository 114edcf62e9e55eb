"""A shard's manifest: which files its folder has, and what was written to them.

    manifest.json   {"format": 1, "files": {name: {"bytes", "rows", "sha256"}}, "replaces": [shards], "trials": [ids], "sha256"}

It is written beside the files, before the folder becomes visible. A compacted shard names in `replaces` the shards whose rows it
holds: from the moment it is visible, these are not. `trials` says which trials the shard holds even when its files no longer do.
`sha256`, the last of the keys, is of `files`, `replaces` and `trials` themselves. Manifests of old have no `trials`, and folders
that were written before there were manifests have none at all.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from sweep.files import flushed, folders_in
from sweep.messages import UserError

NAME = "manifest.json"
#: With these begin the names of the shards that replace others: no other manifest has to be read to know what is visible.
COMPACTED = "c-"
_FORMAT = 1
_SAID = ("files", "replaces", "trials")
_TRIALS = "trials.parquet"
_ADVICE = "`sweep verify` says what else is, `sweep retry` trains it again"
_ADVICE_FOR_STUDIES = "remove it, and launch the study's grid again"


class DamagedError(UserError):
    """A file of the store is not what was written."""

    def __init__(self, file: Path, what: str) -> None:
        advice = _ADVICE_FOR_STUDIES if file.parent.parent.name == "studies" else _ADVICE
        super().__init__(f"{file}: is damaged: {what}; {advice}")
        self.file, self.what = file, what


@dataclass(frozen=True)
class Entry:
    """What was written to a file: so many bytes, with this SHA-256; a table of so many rows."""

    bytes: int
    rows: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """Name → entry of a shard's files, the shards that it replaces, and its trials: None where the manifest does not say."""

    files: Mapping[str, Entry]
    replaces: tuple[str, ...] = field(default=())
    trials: tuple[str, ...] | None = field(default=None)

    def write(self, folder: Path) -> None:
        """Write and flush it to a shard's folder. Trials that are not given are those of the table that lies there."""
        trials = _trials_in(folder / _TRIALS) if self.trials is None else self.trials
        files = {name: vars(entry) for name, entry in self.files.items()}
        said = {"files": files, "replaces": list(self.replaces), "trials": list(trials)}
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
        if content["sha256"] != _digest({key: content[key] for key in _SAID if key in content}):
            raise DamagedError(file, "its content is not what was written")
        entries = {name: _entry(name, values) for name, values in content["files"].items()}
        strangers = [name for name in content["replaces"] if not is_shard_name(name)]
        if strangers:
            raise DamagedError(file, f"it replaces {strangers[0]!r}, which can be no shard")
        return Manifest(entries, tuple(content["replaces"]), _texts(content["trials"]) if "trials" in content else None)
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


def is_shard_name(name: object) -> bool:
    """Return whether a shard's folder may have this name: of a folder in `shards`, seen by everybody, and nowhere else."""
    return isinstance(name, str) and name != "" and not name.startswith(".") and Path(name).name == name


def _digest(said: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _entry(name: str, values: dict[str, Any]) -> Entry:
    if Path(name).name != name or not name.endswith(".parquet"):
        raise ValueError(name)
    return Entry(int(values["bytes"]), int(values["rows"]), str(values["sha256"]))


def _texts(values: Any) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise TypeError(values)
    return tuple(values)


def _trials_in(file: Path) -> tuple[str, ...]:
    with pq.ParquetFile(file, page_checksum_verification=True) as opened:
        return tuple(opened.read(columns=["trial"], use_threads=False)["trial"].to_pylist())


def trials_said(folder: Path) -> tuple[str, ...] | None:
    """Return the trials that a shard's manifest names, whatever has become of its files; None where it does not say.

    Raises FileNotFoundError without the folder.
    """
    try:
        manifest = read(folder)
    except DamagedError:
        return None
    return manifest.trials if manifest else None


def checked_trials(folder: Path) -> tuple[str, ...] | None:
    """Return the trials of a shard, None where its manifest does not say; raise DamagedError as `check_sizes` does.

    It is raised as well for a table of trials that is not, byte for byte, what was written.
    """
    manifest = check_sizes(folder)
    if manifest is None or manifest.trials is None or _TRIALS not in manifest.files:
        return None
    try:
        found = hashlib.sha256((folder / _TRIALS).read_bytes()).hexdigest()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise DamagedError(folder / _TRIALS, f"cannot be read ({error.strerror})") from None
    if found != manifest.files[_TRIALS].sha256:
        raise DamagedError(folder / _TRIALS, "its content is not what was written")
    return manifest.trials


def check_sizes(folder: Path) -> Manifest | None:
    """Return a shard's manifest. Raises DamagedError for a file that is missing or of another size than was written."""
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
    return manifest


def listed(shards: Path, lenient: bool) -> tuple[list[tuple[str, int]], dict[str, set[str]]]:
    """Return the folders in `shards`, and compacted one → names it replaces. Raises DamagedError, FileNotFoundError."""
    found = folders_in(shards)
    replaces: dict[str, set[str]] = {}
    for name, _ in found:
        if name.startswith(COMPACTED):
            try:
                replaces[name] = set(read_written(shards / name).replaces)
            except DamagedError:
                if not lenient:
                    raise
    return found, replaces
