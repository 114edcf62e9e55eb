"""A file system whose n-th call fails, or in which the process is killed at its n-th call."""

import builtins
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest


class Killed(BaseException):
    """The process is no more: no clean-up of its own can touch a file from here on."""


class Faults:
    """Counts the calls that open, write, flush, sync, make, rename and remove files under a folder; fails at one of them.

    `errno`: the call fails with it, once, and all later ones pass. None: it and all later ones raise Killed.
    """

    def __init__(self, root: Path, at: int, errno: int | None) -> None:
        self._root, self._at, self._errno = str(root), at, errno
        self.calls: list[str] = []

    def count(self, name: str, path: Any = None, always: bool = False) -> None:
        if not always and not (isinstance(path, str | os.PathLike) and os.fspath(path).startswith(self._root)):
            return
        self.calls.append(name)
        if self._errno is None and len(self.calls) >= self._at:
            raise Killed(name)
        if self._errno is not None and len(self.calls) == self._at:
            raise OSError(self._errno, os.strerror(self._errno))

    @property
    def happened(self) -> bool:
        return len(self.calls) >= self._at

    @contextmanager
    def installed(self) -> Iterator["Faults"]:
        with pytest.MonkeyPatch.context() as patch:
            for name in ("open", "mkdir", "rename", "replace", "unlink", "rmdir"):
                patch.setattr(os, name, self._counted(name, getattr(os, name)))
            fsync = os.fsync
            patch.setattr(os, "fsync", lambda descriptor: (self.count("fsync", always=True), fsync(descriptor))[1])
            opened = builtins.open

            def open_counted(file: Any, mode: str = "r", *rest: Any, **options: Any) -> Any:
                self.count("open", file)
                found = opened(file, mode, *rest, **options)
                return _File(found, self) if isinstance(file, str | os.PathLike) and "r" not in mode else found

            patch.setattr(builtins, "open", open_counted)
            yield self

    def _counted(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *rest: Any, **options: Any) -> Any:
            self.count(name, path, always=options.get("dir_fd") is not None)
            return real(path, *rest, **options)

        return call


class _File:
    def __init__(self, file: Any, faults: Faults) -> None:
        self._file, self._faults = file, faults

    def write(self, content: Any) -> int:
        self._faults.count("write", always=True)
        return self._file.write(content)

    def flush(self) -> None:
        self._faults.count("flush", always=True)
        self._file.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> "_File":
        return self

    def __exit__(self, *error: Any) -> None:
        self._file.close()
