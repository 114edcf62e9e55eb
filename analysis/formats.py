"""The result of a query as text or bytes: aligned table, CSV, JSON, Markdown, Parquet."""

import csv
import datetime
import decimal
import io
import itertools
import json
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

MOST_ROWS = 1_000
"""Rows that a table shows; the other formats hold all."""

_CONTROL = {code: None for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"}
#: What a spreadsheet runs as a formula, unless the whole text is a number. Both Python and RE2 (Arrow) know these patterns.
FORMULA, NUMBER = r"[=+\-@]", r"[+\-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+\-]?[0-9]+)?|[+\-]?(inf|nan)"


def format_result(table: pa.Table, format: str) -> bytes:
    """Return `table` in one of FORMATS; columns of equal names are numbered: `mean`, `mean_2`."""
    return FORMATS[format](_with_distinct_names(table))


def format_table(table: pa.Table) -> bytes:
    """Aligned columns, numbers to the right; control characters are removed, so that no value can steer a terminal."""
    rows = [[_cell(value).split("\n") for value in row.values()] for row in table.slice(0, MOST_ROWS).to_pylist()]
    names = [_printable(name) for name in table.column_names]
    widths = [max([len(name), *map(len, itertools.chain(*cells))]) for name, *cells in zip(names, *rows, strict=True)]
    right = [pa.types.is_integer(t) or pa.types.is_floating(t) or pa.types.is_decimal(t) for t in table.schema.types]

    def line(texts: list[str]) -> str:
        padded = (f"{t:>{w}}" if r else f"{t:<{w}}" for t, w, r in zip(texts, widths, right, strict=True))
        return "  ".join(padded).rstrip()

    lines = [line(names), "  ".join("─" * width for width in widths)]
    for row in rows:
        lines += (line(list(texts)) for texts in itertools.zip_longest(*row, fillvalue=""))
    shown = f"{MOST_ROWS:,} of " if table.num_rows > MOST_ROWS else ""
    lines.append(f"({shown}{table.num_rows:,} {'row' if table.num_rows == 1 else 'rows'})")
    return ("\n".join(lines) + "\n").encode()


def format_markdown(table: pa.Table) -> bytes:
    """A GitHub table of every row."""
    rows = [table.column_names, ["---"] * table.num_columns, *(map(_cell, row.values()) for row in table.to_pylist())]
    escaped = [[_printable(cell).replace("|", "\\|").replace("\n", "<br>") for cell in row] for row in rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in escaped).encode()


def format_csv(table: pa.Table) -> bytes:
    """RFC 4180 with a header; NULL is empty, numbers keep every digit, lists are JSON.

    Texts that a spreadsheet would run as a formula get an apostrophe in front; numbers do not.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(map(_safe_for_spreadsheets, table.column_names))
    for row in table.to_pylist():
        writer.writerow(map(_safe_for_spreadsheets, map(_plain, row.values())))
    return text.getvalue().encode()


def format_json(table: pa.Table) -> bytes:
    """A list of objects, one a row; NaN and infinities, which JSON lacks, are null."""
    rows = [{name: _jsonable(value) for name, value in row.items()} for row in table.to_pylist()]
    return (json.dumps(rows, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def format_parquet(table: pa.Table) -> bytes:
    """A Parquet file."""
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue()


FORMATS: Mapping[str, Callable[[pa.Table], bytes]] = {
    "table": format_table,
    "csv": format_csv,
    "json": format_json,
    "markdown": format_markdown,
    "parquet": format_parquet,
}


def _with_distinct_names(table: pa.Table) -> pa.Table:
    taken: dict[str, int] = {}
    names = []
    for name in table.column_names:
        while name in taken:
            taken[name] += 1
            name = f"{name}_{taken[name]}"
        taken[name] = 1
        names.append(name)
    return table.rename_columns(names)


def _printable(text: str) -> str:
    return text.translate(_CONTROL).expandtabs(4)


def _cell(value: Any) -> str:
    """Return a value as a reader wants it: six significant digits, NULL by name."""
    if value is None:
        return "NULL"
    if isinstance(value, float):
        return f"{value:.6g}"
    return _printable(str(_plain(value)))


def _plain(value: Any) -> Any:
    """Return a value as CSV holds it."""
    if isinstance(value, list | dict):
        return json.dumps(_jsonable(value), ensure_ascii=False)
    if isinstance(value, bool):
        return str(value).lower()
    return value.isoformat() if isinstance(value, datetime.date | datetime.time) else value


def _jsonable(value: Any) -> Any:
    if isinstance(value, list):
        return [_jsonable(item) for item in value]
    if isinstance(value, dict):
        return {str(name): _jsonable(item) for name, item in value.items()}
    if isinstance(value, decimal.Decimal):
        return int(value) if value == value.to_integral_value() else float(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, str | int | None) else str(_plain(value))


def _safe_for_spreadsheets(value: Any) -> Any:
    is_formula = isinstance(value, str) and re.match(FORMULA, value) and not re.fullmatch(NUMBER, value)
    return f"'{value}" if is_formula else value
