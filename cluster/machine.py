"""What a machine has, and what this process takes of its memory. Elsewhere than on Linux, some answers are None or coarse."""

import contextlib
import ctypes
import gc
import os
import resource
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_PROC, _CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class Machine:
    """A machine: its name, its cores, and the memory in bytes that processes can still take (None: unknown)."""

    host: str
    cores: int
    available_bytes: int | None


def this_machine(device: str = "cpu") -> Machine:
    """Return the machine that this runs on; with "cuda", or "auto" and a GPU there, the memory is the GPU's."""
    available = available_bytes()
    if device != "cpu":
        import torch

        if torch.cuda.is_available():
            available = torch.cuda.mem_get_info()[0]
    return Machine(socket.gethostname(), os.cpu_count() or 1, available)


def available_bytes(proc: Path = _PROC, cgroups: Path = _CGROUPS) -> int | None:
    """Return the bytes that processes can still take, without swapping: the system's, or less where a container is limited."""
    found = [*_fields(proc / "meminfo", "MemAvailable"), *_left_in_cgroups(proc, cgroups)]
    return min(found, default=None)


def _left_in_cgroups(proc: Path, cgroups: Path) -> Iterator[int]:
    """Yield what each limited control group of this process has left (version 2; cached files can be given up)."""
    with contextlib.suppress(OSError, StopIteration):
        lines = (proc / "self" / "cgroup").read_text().splitlines()
        folder = cgroups / next(line for line in lines if line.startswith("0::"))[3:].lstrip("/")
        for group in (folder, *folder.parents):
            if not group.is_relative_to(cgroups):
                return
            with contextlib.suppress(OSError, ValueError):  # "max" is no limit
                limit, used = (int((group / name).read_text()) for name in ("memory.max", "memory.current"))
                statistics = (line.split() for line in (group / "memory.stat").read_text().splitlines())
                cached = sum(int(size) for name, size in statistics if name == "inactive_file")
                yield max(0, limit - used + cached)


def total_bytes() -> int | None:
    """Return the bytes of memory that the machine has."""
    return next(_fields(_PROC / "meminfo", "MemTotal"), None)


def resident_bytes() -> int:
    """Return the bytes that this process has in memory."""
    return next(_fields(_PROC / "self" / "status", "VmRSS"), None) or peak_bytes()


def peak_bytes() -> int:
    """Return the most bytes that this process had in memory since `reset_peak`, or since it began where that does nothing."""
    since_it_began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return next(_fields(_PROC / "self" / "status", "VmHWM"), since_it_began)


def reset_peak() -> None:
    """Count the peak anew from here, where the system can."""
    with contextlib.suppress(OSError):
        (_PROC / "self" / "clear_refs").write_text("5")


def release_freed_memory() -> None:
    """Give back to the system what this process has freed (see `agents.memory`), where the C library can."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def calibrations_file() -> Path | None:
    """Return where this user's calibrations are kept, whether they exist or not; None when there is no home folder."""
    folder = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(folder):  # the standard says to take no notice of it then
        try:
            folder = str(Path.home() / ".cache")
        except RuntimeError:
            return None
    return Path(folder) / "sweep" / "calibrations.json"


def processor() -> str | None:
    """Return the processor's name, as the system gives it."""
    with contextlib.suppress(OSError):
        for line in (_PROC / "cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return None


def _fields(file: Path, name: str) -> Iterator[int]:
    """Yield the bytes behind a name in one of the kernel's tables, which are in kB."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in file.read_text().splitlines():
            if line.startswith(f"{name}:"):
                yield int(line.split()[1]) * 1024
