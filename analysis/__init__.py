"""Reads the Parquet files of a store: SQL views, figures and tables. Runs on a laptop, without torch or Ray."""

from typing import Any

__all__ = ["connect"]


def __getattr__(name: str) -> Any:
    """Import `connect` when it is first asked for, so that importing the package does not load DuckDB."""
    if name == "connect":
        from analysis.database import connect

        return connect
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
