"""What the grids of studies say of how settings are scored and chosen: table `grid_rules`, read without checking a grid again."""

import contextlib
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa

from sweep import study_files
from sweep.grid_checks import SELECT_CHOICES
from sweep.messages import UserError
from sweep.overrides import ANY, EACH, apply

#: One row per study; NULL where its grid says nothing, or cannot be read. `derived`: names of what agents derive from others.
COLUMNS = pa.schema(
    [("study", pa.string())]
    + [(name, pa.list_(pa.string()) if name == "by" else pa.string()) for name in SELECT_CHOICES]
    + [("derived", pa.list_(pa.string()))]
)
#: What of a grid is read here, as `sweep.overrides` is told.
_KEYS = {"select": {ANY: None}, "seeds": {ANY: None}, "agent": {EACH: {"derive": {ANY: None}}}}


def read_rules(folders: Iterable[Path]) -> pa.Table:
    """Return a row for each folder of a study."""
    return pa.Table.from_pylist([{"study": folder.name, **_rules(folder)} for folder in folders], COLUMNS)


def _rules(folder: Path) -> dict[str, Any]:
    """Return the rules in a study's grid, those that are valid choices."""
    try:
        text, overrides = study_files.source(folder)
        raw = tomllib.loads(text)
    except (OSError, ValueError, RecursionError, UserError):
        return {}
    for override in overrides:
        with contextlib.suppress(UserError):  # one that is about something else
            apply(raw, [override], _KEYS)
    select, seeds, agents = raw.get("select"), raw.get("seeds"), raw.get("agent")
    found: dict[str, Any] = {}
    for name, value in (select if isinstance(select, dict) else {}).items():
        listed = value if name == "by" and isinstance(value, list) else [value]
        if listed and all(isinstance(item, str) and item in SELECT_CHOICES.get(name, ()) for item in listed):
            found[name] = sorted(listed) if name == "by" else value
    if not isinstance(seeds, dict) or "evaluate" not in seeds:
        found.pop("by", None)  # nothing is evaluated, and choices are made by either rule
    known = [agent for agent in (agents if isinstance(agents, list) else []) if isinstance(agent, dict)]
    tables = [table for agent in known if isinstance(table := agent.get("derive"), dict)]
    return found | {"derived": sorted({name for table in tables for name in table})}
