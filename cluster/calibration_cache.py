"""Calibrations that were measured before on a machine, in a file of the user's: a property of machines, not of a store.

Whatever is wrong with the file, or with the place that it belongs in, means that nothing was measured before, and is no error.
"""

import contextlib
import json
import os
import uuid
from importlib import metadata
from typing import Any

from agents import kernels
from cluster.machine import Machine, calibrations_file
from cluster.worker import Training
from sweep import provenance
from sweep.calibration import Calibration
from sweep.shards import Group

_FORMAT = 1
_MOST = 1_000  # entries; the oldest give way
_BROKEN = (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError)


def key(group: Group, machine: Machine, executor: str, workers: int, training: Training) -> str:
    """Return all that speed and memory depend on, as canonical JSON: what differs in any of it is measured anew."""
    known: dict[str, Any] = {
        "host": machine.host,
        "executor": executor,
        "workers": workers,
        "threads": training.threads,
        "device": training.device,
        "engine": kernels.engine_name("cuda" if training.device == "cuda" else "cpu", training.tf32),
        "versions": {"torch": _version("torch"), "sweep": _version("sweep-rl"), "commit": provenance.git_commit()},
        "agent": group.agent,
        "environment": group.environment,
        "shared": dict(group.shared),
    }
    return json.dumps(known, sort_keys=True)


def is_there() -> bool:
    """Return whether anything was ever measured: looking up what was not costs a question to a worker."""
    file = calibrations_file()
    with contextlib.suppress(OSError):
        return file is not None and file.exists()
    return False


def load(wanted: str) -> Calibration | None:
    """Return what was measured for a key, if it was and can be read."""
    try:
        return Calibration.from_json(_entries()[wanted])
    except _BROKEN:
        return None


def save(measured: dict[str, Calibration]) -> None:
    """Keep calibrations by their keys, if they can be written. Of two that save at once, one may lose what it measured."""
    file = calibrations_file()
    if file is None or not measured:
        return
    try:
        entries = _entries()
    except _BROKEN:
        entries = {}
    for name, calibration in measured.items():
        entries.pop(name, None)
        entries[name] = calibration.to_json()
    content = {"format": _FORMAT, "calibrations": dict(list(entries.items())[-_MOST:])}
    temporary = file.with_name(f".{file.name}-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(content, indent=1))
        temporary.replace(file)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _entries() -> dict[str, Any]:
    file = calibrations_file()
    if file is None:
        return {}
    found = json.loads(file.read_text("utf-8"))
    if found["format"] != _FORMAT:
        raise ValueError("of another version")
    return dict(found["calibrations"])


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
