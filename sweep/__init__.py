"""Describes sweeps and where their results lie; never does the work. `sweep.load(path)` gives a validated grid."""

from typing import Any

__all__ = ["load"]


def __getattr__(name: str) -> Any:
    if name == "load":
        from sweep.grid import load

        return load
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
