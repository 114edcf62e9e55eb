"""The page of a report: values as a reader wants them, put into `analysis/templates/report.html`.

Names, hosts and errors come from files that anybody may have written: the template escapes every value, no value can steer
the order of text or hide in it, and the page forbids scripts and requests by its own Content-Security-Policy.
"""

import base64
import datetime
import functools
import gzip
import math
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
import pandas as pd
from markupsafe import Markup, escape

from analysis.report_facts import Rows, seed_list
from analysis.report_warnings import versions_text
from sweep.failures import REASONS

if TYPE_CHECKING:
    from analysis.report import Report

SHOWN_ROWS = 200
"""Rows of an exhibit on the page; its CSV has all."""
LARGEST_PLAIN, LARGEST_LINK = 30_000, 1_000_000
"""Bytes of CSV that a page carries for one exhibit as they are, and compressed."""

_STEERING = (*range(9), *range(11, 32), *range(127, 160), *range(0x202A, 0x202F), *range(0x2066, 0x206A))
_REMOVED = dict.fromkeys(_STEERING)


def render(report: "Report") -> str:
    """Return the page."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("analysis", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: value.translate(_REMOVED) if isinstance(value, str) else value,
    )
    environment.filters |= {
        "cell": cell,
        "marked": marked,
        "seeds": seed_list,
        "thousands": lambda value: f"{value:,}",
    }
    settings = {"table tuned-settings", "table selection", "table A.1", "table A.2", "table A.3", "table A.4"}
    return environment.get_template("report.html").render(
        report=report,
        facts=report.facts,
        done=report.facts.count("finished") + report.facts.count("diverged"),
        of_settings=[one for one in report.exhibits if one.label in settings],
        of_results=[one for one in report.exhibits if one.label not in settings],
        reasons=REASONS,
        provenance=provenance(report.facts.provenance),
        rows_of=functools.partial(shown_rows, study=report.facts.study),
        csv_link=csv_link,
    )


def records(data: pd.DataFrame) -> list[dict[str, Any]]:
    """Return a frame's rows as plain values by column."""
    columns = {str(name): [_plain(value) for value in data[name].tolist()] for name in data.columns}
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def shown_rows(data: pd.DataFrame, study: str) -> list[dict[str, Any]]:
    """Return the rows of an exhibit that the page shows, without a column that only repeats the study."""
    repeats = "study" in data and bool((data["study"] == study).all())
    return records(data.head(SHOWN_ROWS).drop(columns="study") if repeats else data.head(SHOWN_ROWS))


def provenance(facts: dict[str, Rows]) -> Rows:
    """Return what trials were trained with and where, one row a value, in one table."""
    return [
        {
            "what": column,
            "value": "unknown" if row["value"] is None else versions_text(row["value"]) if column == "versions" else row["value"],
            "trials": row["trials"],
            "core_hours": None if row["hours"] is None else float(f"{row['hours']:.3g}"),
            "first_finished": row["first"],
            "last_finished": row["last"],
        }
        for column, rows in facts.items()
        for row in rows
    ]


def marked(text: str) -> Markup:
    """Return a text, escaped, with what stands between backticks as code."""
    parts = text.translate(_REMOVED).split("`")
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if number % 2 else escape(part) for number, part in enumerate(parts)
    )


def csv_link(csv: bytes) -> tuple[str, str]:
    """Return a data: link to CSV and the file's suffix; a large one is compressed, the link to a very large one is ""."""
    type, suffix, content = "text/csv;charset=utf-8", "csv", csv
    if len(csv) > LARGEST_PLAIN:
        type, suffix, content = "application/gzip", "csv.gz", gzip.compress(csv, mtime=0)
    return ("" if len(content) > LARGEST_LINK else f"data:{type};base64,{base64.b64encode(content).decode()}"), suffix


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, datetime.date | datetime.time):
        return None if value is pd.NaT else value.isoformat()
    return None if value is pd.NA or value is pd.NaT else value


def jsonable(value: Any) -> Any:
    """Return plain values as JSON knows them: numbers that are not finite are null."""
    if isinstance(value, dict):
        return {str(name): jsonable(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | int) else str(value)


def cell(value: Any) -> str:
    """Return a value as a table of the page shows it: six significant digits, nothing for NULL."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}".replace("-", "−")
    if isinstance(value, int):
        return f"{value:,}".replace("-", "−")
    if isinstance(value, list):
        return ", ".join(cell(item) for item in value)
    if isinstance(value, dict):
        return ", ".join(f"{name} = {cell(item)}" for name, item in value.items())
    return str(value)
