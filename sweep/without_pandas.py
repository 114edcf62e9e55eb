"""What `sweep sql` imports, without pandas: pyarrow's datasets import it where they find it, 0.3 s of which a query has nothing.

pyarrow remembers that there was none. So this is for a process that answers one query and ends, and for no other.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from types import ModuleType


class _NoPandas(MetaPathFinder):
    """Say of pandas that it is not installed."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> None:
        if name == "pandas":
            raise ModuleNotFoundError("no pandas here", name=name)


def import_query() -> None:
    """Import `analysis.query`."""
    finder = _NoPandas()
    sys.meta_path.insert(0, finder)
    try:
        import analysis.query  # noqa: F401
    finally:
        sys.meta_path.remove(finder)
