"""What this installation is and what it runs on: the first thing to ask when training is slow, or not where it was expected."""

import os
import platform
from importlib import metadata
from typing import Any

from agents import kernels
from agents.kernels.native import NotAvailableError, load
from cluster import machine
from sweep.messages import UserError

_DISTRIBUTIONS = {"sweep": "sweep-rl"} | {
    name: name for name in ("torch", "numpy", "ray", "duckdb", "pyarrow", "gymnasium", "pandas", "seaborn", "matplotlib")
}
_NOT_INSTALLED = "not installed"


def check_engine(device: str, *, here: bool = False) -> None:
    """Raise UserError when SWEEP_ENGINE asks for what cannot be had on this type of device, or when there is no GPU `here`."""
    if here and device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise UserError(
                "--device cuda: torch finds no GPU here that it can use (`sweep doctor`); --device auto takes one if there is"
            )
    try:
        kernels.engine_name("cuda" if device == "cuda" else "cpu")
    except kernels.EngineError as error:
        raise UserError(str(error)) from None


def examine() -> dict[str, Any]:
    """Return what is known of the installation and the machine, as values that JSON knows; bytes are whole numbers.

    Raises UserError when SWEEP_ENGINE asks for what cannot be had. Imports torch, where it is, to see whether there is a GPU.
    """
    check_engine("cpu")
    report = kernels.report()
    cache = machine.calibrations_file()
    return {
        "engine": report.engine,
        "engine_reason": report.reason,
        "compiled": _compiled(),
        "processor": machine.processor() or platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "memory_bytes": machine.total_bytes(),
        "available_memory_bytes": machine.available_bytes(),
        "cuda": _cuda(),
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in _DISTRIBUTIONS},
        "calibrations": str(cache) if cache else None,
    }


def lines(found: dict[str, Any]) -> list[str]:
    """Return what `examine` found, for people."""
    memory, available = found["memory_bytes"], found["available_memory_bytes"]
    shown = {
        "engine": f"{found['engine']} ({found['engine_reason']})",
        "processor": f"{found['processor']}, {found['cores']} cores",
        "memory": f"{_gigabytes(memory)}, {_gigabytes(available)} available",
        "GPU": found["cuda"] or "none that torch can use",
        **found["versions"],
        "calibrations": found["calibrations"] or "nowhere: this user has no home folder",
    }
    width = max(map(len, shown))
    return [f"{name:<{width}}  {value}" for name, value in shown.items()]


def _compiled() -> list[str]:
    try:
        return list(load(None).compiled)
    except NotAvailableError:
        return []


def _cuda() -> str | None:
    try:
        import torch
    except ModuleNotFoundError:
        return None
    return torch.cuda.get_device_name() if torch.cuda.is_available() else None


def _version(name: str) -> str:
    try:
        return metadata.version(_DISTRIBUTIONS[name])
    except metadata.PackageNotFoundError:
        return _NOT_INSTALLED


def _gigabytes(count: int | None) -> str:
    return "unknown" if count is None else f"{count / 2**30:.1f} GB"
