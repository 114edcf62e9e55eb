"""Figure numbers of the thesis → kind of figure, title, and the study that shows it. Loads no plotting library.

A kind is a module of this package with `draw(connection, study, title) -> Drawing`, whose docstring is the caption, and
`studies(connection) -> list[str]`: the studies in a store that have data for it.
"""

import importlib
import inspect
from dataclasses import dataclass
from types import ModuleType

from sweep.messages import UserError, suggestion


@dataclass(frozen=True)
class Entry:
    """A figure by number: its kind (a module's name), its title, the built-in study that it was made for."""

    number: str
    kind: str
    title: str
    study: str

    def load(self) -> ModuleType:
        """Import and return the module that draws it."""
        return importlib.import_module(f"analysis.figures.{self.kind}")

    @property
    def caption(self) -> str:
        """The caption: the docstring of the kind's `draw`."""
        return inspect.getdoc(self.load().draw) or ""


FIGURES: dict[str, Entry] = {
    entry.number: entry
    for entry in (Entry("7.1", "sensitivity_region", "Sensitivity to critic step-size and entropy scale", "figure-7-1"),)
}


def find(number: str) -> Entry:
    """Return the figure of that number; UserError with the known ones if there is none."""
    if number not in FIGURES:
        raise UserError(f'unknown figure "{number}": {suggestion(number, FIGURES)}')
    return FIGURES[number]


def list_figures() -> list[str]:
    """Return a line for each figure: its number and title."""
    return [f"{entry.number}  {entry.title}" for entry in FIGURES.values()]
