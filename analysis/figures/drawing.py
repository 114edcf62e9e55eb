"""What drawing a figure yields: the figure, the numbers in it, the SQL behind them, and what its reader has to know."""

from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

_METADATA = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}


@dataclass(frozen=True)
class Drawing:
    """A figure, the rows it shows, notes (lines for the terminal: n, what is missing, what diverged), and the rows' SQL.

    `sql` is one statement that `sweep sql` runs on the same store. It yields `data`, or, where a figure shows statistics that SQL
    cannot say, the scores that they were computed from. Empty for a demonstration.
    """

    figure: Figure
    data: pd.DataFrame
    notes: list[str] = field(default_factory=list)
    sql: str = ""

    def save(self, file: Path, format: str) -> None:
        """Write the figure (png, svg, pdf), its rows (csv) or its query (sql).

        The same data give the same bytes: no date, no random ids.
        """
        if format == "csv":
            self.data.to_csv(file, index=False)
        elif format == "sql":
            file.write_text(self.sql.strip() + "\n", encoding="utf-8")
        else:
            with rc_context({"svg.hashsalt": "sweep", "pdf.fonttype": 42}):
                self.figure.savefig(file, format=format, dpi=200, metadata=_METADATA[format])
