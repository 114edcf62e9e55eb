"""What building a table yields: its rows, the SQL behind them, and what its reader has to know."""

from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
import pyarrow as pa

from analysis.formats import format_result


@dataclass(frozen=True)
class Table:
    """The rows of a table as a reader wants them, notes for the terminal, and `sql`, as in `analysis.figures.drawing`."""

    data: pd.DataFrame
    notes: list[str] = field(default_factory=list)
    sql: str = ""

    def text(self) -> str:
        """Return the table with aligned columns."""
        return format_result(self._arrow(), "table").decode()

    def save(self, file: Path, format: str) -> None:
        """Write the rows (csv, json, markdown, parquet) or their query (sql)."""
        content = (self.sql.strip() + "\n").encode() if format == "sql" else format_result(self._arrow(), format)
        file.write_bytes(content)

    def _arrow(self) -> pa.Table:
        return pa.Table.from_pandas(self.data, preserve_index=False).replace_schema_metadata(None)
