"""Values written into the SQL that a figure or table hands on: one statement that runs as it is, without parameters."""

from collections.abc import Iterable


def quoted(text: str) -> str:
    """Return a text as SQL writes it."""
    return "'" + str(text).replace("'", "''") + "'"


def listed(texts: Iterable[str]) -> str:
    """Return distinct texts, sorted, for `IN (…)`."""
    return ", ".join(map(quoted, sorted(set(texts)))) or "NULL"
