"""Checkpoint files: a header with named arrays and plain values, written whole or not at all, and checked when they are read.

    .checkpoints/<shard>.checkpoint     in a store's folder

A file is: a line that names the format; the SHA-256 of all that follows it; that of the JSON text alone; the text's length; the
text, which holds the caller's header, the plain values, and each array's type, shape and place; the arrays, each at a multiple of
64 bytes. Nothing is pickled.
"""

import contextlib
import hashlib
import json
import os
import time
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

State = Mapping[str, np.ndarray | int | float | bool | str | None]

_FOLDER, _ENDING = ".checkpoints", ".checkpoint"
_MAGIC = b"sweep checkpoint, format 1\n"
_DIGEST_SIZE, _LENGTH_SIZE = 32, 8
_BEFORE_TEXT = len(_MAGIC) + 2 * _DIGEST_SIZE + _LENGTH_SIZE
_ALIGNMENT = 64
_PIECE = 1 << 23
_STALE_SECONDS = 3600


class DamagedCheckpointError(Exception):
    """A checkpoint's file is not what was written; the message names it and says what is wrong."""


def file_of(store: Path, shard: str) -> Path:
    """Return where the checkpoint of a shard lies in a store's folder, if there is one."""
    return store / _FOLDER / f"{shard}{_ENDING}"


def files(store: Path) -> list[Path]:
    """Return the checkpoints in a store's folder, whatever their state, by name."""
    return sorted((store / _FOLDER).glob(f"*{_ENDING}"))


def remove(store: Path, shard: str) -> None:
    """Remove the checkpoint of a shard, if there is one and it can be removed."""
    with contextlib.suppress(OSError):
        file_of(store, shard).unlink(missing_ok=True)


def save(file: Path, header: Mapping[str, Any], state: State) -> int:
    """Write a checkpoint and return its size in bytes. The one that was there stays valid until the new one is on disk.

    `header` is anything that JSON can hold. Arrays are written piece by piece: beside them, some megabytes of memory are needed.
    Raises TypeError for a value that is neither plain nor an array of numbers, OSError when it cannot be written.
    """
    text, places = _table(header, state)
    file.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(file.parent)
    temporary = file.with_name(f".{file.name}-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    try:
        with open(temporary, "wb") as sink:
            size = _write(sink, text, places, state)
            sink.flush()
            os.fsync(sink.fileno())
        temporary.replace(file)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    _flush_folder(file.parent)
    return size


def load(file: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the header and the state that were saved. Arrays are read-only maps of the file, which may be replaced meanwhile.

    Raises DamagedCheckpointError unless the file is, bit for bit, what was written, FileNotFoundError when there is none.
    """
    with open(file, "rb") as source:
        digest, text = _read_text(file, source)
        source.seek(len(_MAGIC) + _DIGEST_SIZE)
        found = hashlib.sha256()
        while piece := source.read(_PIECE):
            found.update(piece)
        if found.digest() != digest:
            raise DamagedCheckpointError(f"{file}: is damaged: its checksum is not the one that was written")
        content = (
            np.memmap(source, np.uint8, "r", _BEFORE_TEXT + len(text)) if _arrays_follow(source, text) else np.zeros(0, np.uint8)
        )
    table = json.loads(text)
    state: dict[str, Any] = dict(table["values"])
    for name, (dtype, shape, place, size) in table["arrays"].items():
        state[name] = content[place : place + size].view(np.ndarray).view(np.dtype(dtype)).reshape(shape)
    return table["header"], {name: state[name] for name in table["order"]}


def read_header(file: Path) -> dict[str, Any]:
    """Return the header alone; the arrays are neither read nor checked. Raises as `load` does."""
    with open(file, "rb") as source:
        header: dict[str, Any] = json.loads(_read_text(file, source)[1])["header"]
    return header


def _read_text(file: Path, source: IO[bytes]) -> tuple[bytes, bytes]:
    """Return the digest of all that follows it, and the JSON text."""
    magic, digest, of_text, length = (source.read(n) for n in (len(_MAGIC), _DIGEST_SIZE, _DIGEST_SIZE, _LENGTH_SIZE))
    if magic != _MAGIC:
        raise DamagedCheckpointError(f"{file}: is no checkpoint, or of a format that this version does not read")
    size = min(int.from_bytes(length, "little"), os.fstat(source.fileno()).st_size)  # whatever a damaged length says
    text = source.read(size)
    if hashlib.sha256(text).digest() != of_text:
        raise DamagedCheckpointError(f"{file}: is damaged: the checksum of its header is not the one that was written")
    return digest, text


def _arrays_follow(source: IO[bytes], text: bytes) -> bool:
    return os.fstat(source.fileno()).st_size > _BEFORE_TEXT + len(text)


def _table(header: Mapping[str, Any], state: State) -> tuple[bytes, dict[str, int]]:
    """Return the JSON text, padded so that arrays may begin where it ends, and array → its place from there on."""
    values: dict[str, Any] = {}
    arrays: dict[str, list[Any]] = {}
    offset = 0
    for name, value in state.items():
        if isinstance(value, np.ndarray) and not value.dtype.hasobject and value.dtype.names is None:
            arrays[name] = [value.dtype.str, list(value.shape), offset, value.nbytes]
            offset += _aligned(value.nbytes)
        elif value is None or type(value) in (bool, int, float, str):
            values[name] = value
        else:
            raise TypeError(f"{name}: a {type(value).__name__} cannot be saved in a checkpoint")
    table = {"header": dict(header), "order": list(state), "values": values, "arrays": arrays}
    text = json.dumps(table).encode()
    return text.ljust(_aligned(_BEFORE_TEXT + len(text)) - _BEFORE_TEXT), {name: place[2] for name, place in arrays.items()}


def _write(sink: IO[bytes], text: bytes, places: Mapping[str, int], state: State) -> int:
    digest = hashlib.sha256()

    def write(piece: Any) -> None:
        sink.write(piece)
        digest.update(piece)

    sink.write(_MAGIC + bytes(_DIGEST_SIZE))
    write(hashlib.sha256(text).digest())
    write(len(text).to_bytes(_LENGTH_SIZE, "little"))
    write(text)
    first = sink.tell()
    for name, place in places.items():
        write(bytes(first + place - sink.tell()))
        array = state[name]
        assert isinstance(array, np.ndarray)
        for piece in _pieces(array):
            write(piece)
    size = sink.tell()
    sink.seek(len(_MAGIC))
    sink.write(digest.digest())
    return size


def _pieces(array: np.ndarray) -> Iterator[memoryview]:
    """Yield an array's bytes in C order, copying no more than a piece of it at a time."""
    if array.nbytes and (array.flags.c_contiguous or array.nbytes <= _PIECE):
        content = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        for start in range(0, len(content), _PIECE):
            yield content[start : start + _PIECE].data
    elif array.nbytes:
        rows = max(1, _PIECE * len(array) // array.nbytes)
        for start in range(0, len(array), rows):
            part = array[start : start + rows]
            yield from _pieces(part if len(part) > 1 else part[0])


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def _remove_stale(folder: Path) -> None:
    """Remove what a killed process left half written an hour ago or earlier; another may be writing just now."""
    for file in folder.glob(f".*{_ENDING}-*"):
        with contextlib.suppress(OSError):
            if time.time() - file.stat().st_mtime > _STALE_SECONDS:
                file.unlink()


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
