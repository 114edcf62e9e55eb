"""What drawing a figure yields: the figure, the numbers in it, and what its reader has to know."""

from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

_METADATA = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}


@dataclass(frozen=True)
class Drawing:
    """A figure, the rows it shows, and notes: lines for the terminal about missing or diverged trials."""

    figure: Figure
    data: pd.DataFrame
    notes: list[str] = field(default_factory=list)

    def save(self, file: Path, format: str) -> None:
        """Write the figure (png, svg, pdf) or its rows (csv). The same data give the same bytes: no date, no random ids."""
        if format == "csv":
            self.data.to_csv(file, index=False)
            return
        with rc_context({"svg.hashsalt": "sweep", "pdf.fonttype": 42}):
            self.figure.savefig(file, format=format, dpi=200, metadata=_METADATA[format])
