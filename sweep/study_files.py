"""What a store keeps of a study: its grid, what `--set` changed of it, and the trials that it needs.

studies/<study>/grid.toml         the grid file's text
studies/<study>/overrides.json    what `--set` changed of it; absent when that is nothing
studies/<study>/members.parquet   the trials, as in `schema.MEMBERS`
"""

import json
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from sweep import shard_files
from sweep.files import UnwritableError, flush_folder, write_atomically
from sweep.messages import UserError

GRID, OVERRIDES, MEMBERS = "grid.toml", "overrides.json", "members.parquet"


def write(folder: Path, grid: str, members: pa.Table, overrides: Sequence[str]) -> None:
    """Write a study's files, those that differ from what is there. Raises UnwritableError."""
    sink = pa.BufferOutputStream()
    pq.write_table(members, sink, compression="zstd", write_page_checksum=True)
    contents = {
        GRID: grid.encode(),
        OVERRIDES: json.dumps(list(overrides)).encode() if overrides else None,
        MEMBERS: sink.getvalue().to_pybytes(),
    }
    try:
        for file, content in contents.items():
            keep(folder / file, content)
    except OSError as error:
        message = f"{folder}: the study cannot be written to this store: {error.strerror or error}"
        raise UnwritableError(message, error.errno) from None


def keep(file: Path, content: bytes | None) -> None:
    """See to it that a study's file has this content, or that there is none, on disk as well. Raises OSError."""
    if content is None and file.exists():
        file.unlink(missing_ok=True)
        flush_folder(file.parent)
    elif content is None:
        return
    elif not file.exists() or file.read_bytes() != content:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, content)


def source(folder: Path) -> tuple[str, tuple[str, ...]]:
    """Return the grid's text and what `--set` changed of it. Raises FileNotFoundError, and UserError for a damaged file."""
    try:
        grid = (folder / GRID).read_text("utf-8")
        texts = json.loads((folder / OVERRIDES).read_bytes()) if (folder / OVERRIDES).exists() else []
        if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
            raise ValueError(f"{OVERRIDES} is no list of texts")
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise UserError(f"{folder}: is damaged and cannot be read: {error}; launch the study's grid file again") from None
    return grid, tuple(texts)


def trials(folder: Path, stage: str | None) -> set[str]:
    """Return the trials that a study needs, in one stage or all; none without the file. Raises DamagedError."""
    file = folder / MEMBERS
    if not file.exists():
        return set()
    members = shard_files.read_table(file, ["stage", "trial"])
    if stage is not None:
        members = members.filter(pc.equal(members["stage"], stage))
    return set(members["trial"].to_pylist())
