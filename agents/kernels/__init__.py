"""The engines that do the arithmetic of populations, and which of them is active.

"native": the C++ kernels of `agents/kernels/src`, on the CPU, where they were compiled when the package was installed and the
processor has the instructions. "torch": the same arithmetic in PyTorch, everywhere else, and the oracle that tests compare with.
An agent's numbers depend on the engine in their last bits only, but training amplifies these: it is recorded with each trial.

Torch-free: `sweep doctor` reports without loading torch.
"""

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass

from agents.kernels.native import Library, NotAvailableError, load

VARIABLE = "SWEEP_ENGINE"
CHOICES = ("auto", "native", "torch")


class EngineError(RuntimeError):
    """The engine that was asked for cannot be had."""


@dataclass(frozen=True)
class Report:
    """Which engine serves the CPU ("native-avx2", "torch", …), and why."""

    engine: str
    reason: str


_chosen: list[str] = []


def library(device: str) -> Library | None:
    """Return the native kernels if they serve this type of device ("cpu", "cuda"), else None: then PyTorch does the arithmetic.

    The environment variable SWEEP_ENGINE asks for "native", "torch", "auto" (default) or a variant such as "native-avx2".
    It concerns the CPU: a GPU has the torch engine whatever it says. Raises EngineError when it asks for what cannot be had.
    """
    asked = _chosen[-1] if _chosen else os.environ.get(VARIABLE) or "auto"
    wanted, _, variant = asked.partition("-")
    if wanted not in CHOICES or (variant and wanted != "native"):
        raise EngineError(f"{VARIABLE} = {asked}: must be one of {', '.join(CHOICES)}, or a variant such as native-avx2")
    if wanted == "torch" or device != "cpu":
        return None
    try:
        return load(variant or None)
    except NotAvailableError as error:
        if wanted == "native":
            raise EngineError(f"{VARIABLE} = {asked}: {error}") from error
        return None


def engine_name(device: str, tf32: bool = False) -> str:
    """Return what is recorded with a trial trained on this type of device: "torch", "torch-tf32", "native-" and the variant."""
    found = library(device)
    if found is not None:
        return f"native-{found.variant}"
    return "torch-tf32" if tf32 and device == "cuda" else "torch"


def report() -> Report:
    """Return which engine trains on the CPU and why. Raises EngineError as `library` does."""
    name = engine_name("cpu")
    try:
        found = load(None)
    except NotAvailableError as error:
        return Report(name, str(error))
    described = f"{found.path.name}, compiled for {', '.join(found.compiled)}"
    if name == "torch":
        return Report(name, f"{VARIABLE} asks for it, though the native kernels are here ({described})")
    return Report(name, described)


@contextlib.contextmanager
def using(engine: str) -> Iterator[None]:
    """Ask for an engine within a block, whatever SWEEP_ENGINE says; networks, optimizers and streams made there keep it."""
    _chosen.append(engine)
    try:
        yield
    finally:
        _chosen.pop()
