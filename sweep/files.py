"""Files that are on disk, whole, before anybody is shown them."""

import contextlib
import hashlib
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from sweep.messages import UserError

_COPY_BYTES = 1 << 20


class UnwritableError(UserError, OSError):
    """Something cannot be written to the store; `errno` says why."""

    def __init__(self, message: str, errno: int | None = None) -> None:
        super().__init__(message)
        self.errno = errno


class Sink:
    """An open file to write to, in one go from its beginning, that knows the size and the SHA-256 of what was written."""

    closed = False  # pyarrow asks; `flushed` closes the file

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._hash = hashlib.sha256()
        self.bytes = 0

    @property
    def sha256(self) -> str:
        """64 hexadecimal digits."""
        return self._hash.hexdigest()

    def write(self, content: Any) -> int:
        """Write bytes, or whatever looks like them."""
        self._file.write(content)
        self._hash.update(content)
        self.bytes += len(content)
        return len(content)

    def tell(self) -> int:
        """Return how many bytes were written."""
        return self.bytes

    def flush(self) -> None:
        """Hand what was written to the system."""
        self._file.flush()


@contextlib.contextmanager
def flushed(file: Path) -> Iterator[Sink]:
    """Open a file to write to; what was written is on disk afterwards."""
    with open(file, "wb") as opened:
        yield Sink(opened)
        opened.flush()
        os.fsync(opened.fileno())


def write_atomically(file: Path, content: bytes, flush: bool = True) -> None:
    """Put a file in place that has this content from the first moment on, instead of any that was there."""
    temporary = file.with_name(f".{file.name}-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    try:
        with open(temporary, "wb") as sink:
            sink.write(content)
            if flush:
                sink.flush()
                os.fsync(sink.fileno())
        temporary.replace(file)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    if flush:
        flush_folder(file.parent)


def copy(source: Path, target: Path) -> Sink:
    """Copy a file and flush the copy; return its sink, which knows the size and the SHA-256."""
    with open(source, "rb") as content, flushed(target) as sink:
        shutil.copyfileobj(content, sink, _COPY_BYTES)
    return sink


def digest(file: Path) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits. Raises OSError."""
    with open(file, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def flush_folder(folder: Path) -> None:
    """Put on disk which files a folder has."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def folders_in(folder: Path) -> list[tuple[str, int]]:
    """Return the folders in one as (name, inode), by name; none when there is no such folder."""
    try:
        with os.scandir(folder) as entries:
            return sorted((entry.name, entry.inode()) for entry in entries if entry.name[0] != "." and entry.is_dir())
    except FileNotFoundError:
        return []
