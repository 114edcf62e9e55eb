"""What launches under way say of themselves in a store: where they are, what they train now, whether they are to stop.

    .launches/<launch>.json     its heartbeat, written anew every few seconds: counts, rate, time left, trials being trained
    .launches/<launch>.drain    its workers begin nothing new
    .launches/<launch>.stop     its workers write a checkpoint and stop

Nothing here is needed for the store to be right, which `Store.commit` sees to. It spares two launches the training of the same
trials, tells `sweep status`, from anywhere, how far a launch is, and lets workers on other machines know of a Ctrl-C.
"""

import contextlib
import json
import os
import socket
import time
import uuid
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

#: Seconds between two heartbeats, and without one until a launch counts as dead.
BEAT_SECONDS = 2.0
DEAD_SECONDS = 60.0
_FOLDER = ".launches"


class Heartbeat:
    """A launch's own file. Whatever goes wrong with it is no error: the launch goes on unseen."""

    def __init__(self, store: Path, study: str) -> None:
        self.id = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        self._file = store / _FOLDER / f"{self.id}.json"
        self._known = {"study": study, "host": socket.gethostname(), "pid": os.getpid(), "started": time.time()}
        self._beats = 0
        self._last = -BEAT_SECONDS

    def beat(self, news: Callable[[], Mapping[str, Any]], *, now: bool = False) -> None:
        """Write the file anew with what `news` returns, if the last time is BEAT_SECONDS ago, or `now`."""
        if not now and time.monotonic() - self._last < BEAT_SECONDS:
            return
        self._last = time.monotonic()
        self._beats += 1
        content = {**self._known, "beats": self._beats, "updated": time.time(), **news()}
        temporary = self._file.with_suffix(".new")
        with contextlib.suppress(OSError):
            self._file.parent.mkdir(exist_ok=True)
            temporary.write_text(json.dumps(content))
            temporary.replace(self._file)

    def ask_workers_to(self, what: str) -> None:
        """Leave a note for the workers: "drain" or "stop"."""
        with contextlib.suppress(OSError):
            self._file.parent.mkdir(exist_ok=True)
            self._file.with_suffix(f".{what}").touch()

    def end(self) -> None:
        """Remove what this launch wrote, when nobody reads it any longer."""
        for suffix in (".json", ".new", ".drain", ".stop"):
            with contextlib.suppress(OSError):
                self._file.with_suffix(suffix).unlink(missing_ok=True)


def asked_to(store: Path, launch: str, what: str) -> bool:
    """Return whether a launch has left its workers the note "drain" or "stop"."""
    return bool(launch) and (store / _FOLDER / f"{launch}.{what}").exists()


class Neighbors:
    """The other launches on a store, as one launch sees them.

    One is dead when its heartbeat has stood still for DEAD_SECONDS of this process' own clock: the clocks of two machines, or a
    clock that is set back, do not matter.
    """

    def __init__(self, store: Path, own: str) -> None:
        self._folder, self._own = store / _FOLDER, own
        self._seen: dict[str, tuple[int, float]] = {}

    def claimed(self) -> set[str]:
        """Return the trials that living launches train now."""
        trials: set[str] = set()
        for name, content in _read(self._folder):
            if name != self._own and self._lives(name, content):
                trials.update(content.get("trials", ()))
        return trials

    def _lives(self, name: str, content: Mapping[str, Any]) -> bool:
        if _process_is_gone(content):
            return False
        beats, now = content.get("beats", 0), time.monotonic()
        if name not in self._seen or self._seen[name][0] != beats:
            self._seen[name] = (beats, now)
        return now - self._seen[name][1] < DEAD_SECONDS


def under_way(store: Path) -> list[dict[str, Any]]:
    """Return what the living launches on a store say of themselves, by their start: for `sweep status`, which looks only once."""
    found = []
    for name, content in _read(store / _FOLDER):
        if not _process_is_gone(content) and abs(time.time() - content.get("updated", 0)) < DEAD_SECONDS:
            found.append({"launch": name, **content})
    return sorted(found, key=lambda one: (one.get("started", 0), one["launch"]))


def clean_up(store: Path) -> None:
    """Remove what launches that died a day ago or earlier left behind."""
    for file in (store / _FOLDER).glob("*"):
        with contextlib.suppress(OSError):
            if time.time() - file.stat().st_mtime > 24 * 3600:
                file.unlink()


def _read(folder: Path) -> Iterable[tuple[str, dict[str, Any]]]:
    for file in sorted(folder.glob("*.json")):
        with contextlib.suppress(OSError, ValueError):
            content = json.loads(file.read_text("utf-8"))
            if isinstance(content, dict):
                yield file.stem, content


def _process_is_gone(content: Mapping[str, Any]) -> bool:
    """Whether the launch ran on this machine and its process is no more."""
    if content.get("host") != socket.gethostname() or type(content.get("pid")) is not int:
        return False
    try:
        os.kill(content["pid"], 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False
