"""SQL on a store for `sweep sql`: exactly one statement that only reads, and errors without a traceback.

The connection itself is denied every file and every change of its settings (`analysis.database`); the check of the
statement is there to say so clearly, before anything runs.
"""

import re
import sys
from pathlib import Path
from typing import BinaryIO

import duckdb
import pyarrow as pa

from analysis.database import connect
from analysis.formats import FORMATS, format_result
from sweep.messages import UserError, suggestion

_READS = (duckdb.StatementType.SELECT, duckdb.StatementType.EXPLAIN)
_RULE = "a query is one SELECT, FROM, WITH, VALUES, DESCRIBE, SHOW, SUMMARIZE or EXPLAIN"


def run(store: Path, sql: str, format: str = "table", out: BinaryIO | None = None) -> None:
    """Write the result of `sql` to `out` (standard output if None) as table, csv, json, markdown or parquet."""
    if format not in FORMATS:
        raise UserError(f'unknown format "{format}": {suggestion(format, FORMATS)}')
    (out or sys.stdout.buffer).write(format_result(run_query(store, sql), format))


def run_query(store: str | Path, sql: str) -> pa.Table:
    """Return the result of one reading statement; UserError if it is anything else or does not run."""
    connection = connect(store)
    try:
        check_reads_only(connection, sql)
        return connection.sql(sql).to_arrow_table()
    except duckdb.Error as error:
        raise UserError(f"SQL: {short_message(error)}") from None
    finally:
        connection.close()


def check_reads_only(connection: duckdb.DuckDBPyConnection, sql: str) -> None:
    """Raise UserError unless `sql` is exactly one statement that reads; duckdb.Error where it does not parse."""
    statements = connection.extract_statements(sql)
    if not statements:
        raise UserError(f"SQL: the query is empty: {_RULE}")
    if len(statements) != 1:
        raise UserError(f"SQL: {len(statements)} statements: {_RULE}")
    if statements[0].type == duckdb.StatementType.MULTI:
        raise UserError("SQL: PIVOT needs its values here: PIVOT … ON column IN (value, …)")
    if statements[0].type not in _READS:
        raise UserError(f"SQL: {statements[0].type.name} is not allowed: {_RULE}; the store is read-only here")
    if statements[0].type == duckdb.StatementType.EXPLAIN:
        _check_explained(connection, statements[0].query)


def _check_explained(connection: duckdb.DuckDBPyConnection, sql: str) -> None:
    """Check what EXPLAIN explains: EXPLAIN ANALYZE runs it."""
    explained = re.sub(r"^\s*EXPLAIN\s+(ANALYZE\s+)?", "", sql, flags=re.IGNORECASE)
    try:
        types = [statement.type for statement in connection.extract_statements(explained)]
    except duckdb.Error:
        types = []
    if types != [duckdb.StatementType.SELECT]:
        raise UserError("SQL: EXPLAIN and EXPLAIN ANALYZE, without options, are for one SELECT; the store is read-only here")


def short_message(error: duckdb.Error) -> str:
    """Return DuckDB's message and candidates on one line, without the kind of error and the excerpt of the query."""
    text = re.split(r"\n\s*LINE \d+:", str(error))[0]
    if re.search(r"Failed to open local file '.*/shards/.*No such file", text, re.DOTALL):
        return "the store was compacted meanwhile: ask again"
    return re.sub(r"\s+", " ", re.sub(r"^[A-Z][\w ]* Error: ", "", text)).strip()
