"""Where and with what a trial was trained: commit, versions, host, device, engine."""

import functools
import json
import platform
import socket
import subprocess
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

_DISTRIBUTIONS = ("sweep-rl", "torch", "numpy", "gymnasium", "mujoco")


@dataclass(frozen=True)
class Provenance:
    """What is the same for all trials of a shard."""

    device: str
    engine: str
    host: str
    commit: str | None
    versions: str

    def columns(self) -> dict[str, str | None]:
        """Return the columns of the table of trials."""
        return {
            "device": self.device,
            "engine": self.engine,
            "host": self.host,
            "commit": self.commit,
            "versions": self.versions,
        }


def of_this_process(device: str, engine: str) -> Provenance:
    """Return the provenance of what this process trains."""
    return Provenance(device, engine, socket.gethostname(), git_commit(), json.dumps(_versions(), sort_keys=True))


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in _DISTRIBUTIONS:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


@functools.cache
def git_commit() -> str | None:
    """Return the commit of this code, with `+dirty` when tracked files differ from it; None when it is not in a git checkout."""
    file = Path(__file__)

    def git(*arguments: str) -> str | None:
        try:
            ran = subprocess.run(["git", "-C", str(file.parent), *arguments], capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return ran.stdout.strip() if ran.returncode == 0 else None

    if git("ls-files", "--error-unmatch", file.name) is None:
        return None
    commit = git("rev-parse", "HEAD")
    return commit and commit + ("+dirty" if git("status", "--porcelain", "--untracked-files=no") else "")
