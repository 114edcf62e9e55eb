"""Tables by name: the thesis' by their numbers, and the kinds for studies of one's own.

A kind is a module of this package with

    TAKES                                   the names of the `Options` that it takes
    build(connection, study, options)       → Table; its docstring is the caption; NoDataError if the study has nothing for it
    studies(connection, options)            → list[str]: the studies in the store that have data for it, the likeliest first
"""

import importlib
import inspect
from dataclasses import dataclass, field
from types import ModuleType

from analysis.figures.options import Options
from sweep.messages import UserError, suggestion


@dataclass(frozen=True)
class Entry:
    """A table by name: its kind (a module's name), its title, the built-in studies made for it, and what is shown of a study."""

    name: str
    kind: str
    title: str
    studies: tuple[str, ...] = ()
    options: Options = field(default_factory=Options)

    def load(self) -> ModuleType:
        """Import and return the module that builds it."""
        return importlib.import_module(f"analysis.tables.{self.kind}")

    @property
    def caption(self) -> str:
        """The caption: the docstring of the kind's `build`."""
        return inspect.getdoc(self.load().build) or ""


def _tuned(number: str, agent: str) -> Entry:
    options = Options(by="per-environment", agents=(agent,))
    return Entry(
        number,
        "tuned_settings",
        f"Settings of {agent}, tuned per environment",
        ("chapter-6", "published-per-environment"),
        options,
    )


THESIS = (
    Entry(
        "6.1",
        "best_returns",
        "Approximately optimal returns: the highest of one episode",
        ("chapter-6", "published-per-environment"),
    ),
    Entry("A.1", "tuned_settings", "Settings tuned across environments", ("chapter-6",), Options(by="across-environments")),
    _tuned("A.2", "GreedyAC"),
    _tuned("A.3", "VanillaAC"),
    _tuned("A.4", "SAC"),
)
KINDS = (
    Entry("best-returns", "best_returns", "Highest return of one episode"),
    Entry("tuned-settings", "tuned_settings", "Chosen settings", options=Options(by="per-environment")),
    Entry("performance", "performance", "Performance of the chosen settings, with intervals"),
    Entry("aggregates", "aggregates", "Aggregates over environments"),
    Entry("comparison", "comparison", "Differences between agents"),
    Entry("selection", "selection", "How certain the choice of settings is"),
    Entry("sensitivity", "sensitivity", "Hyperparameter sensitivity and effective dimensionality"),
    Entry("importance", "importance", "Share of the variance that each hyperparameter explains"),
    Entry("claims", "claims", "What the thesis says of its figures, and what these runs say to it"),
    Entry("normalizers", "normalizers", "Settings chosen under each normalizer, and with one environment left out"),
)
TABLES: dict[str, Entry] = {entry.name: entry for entry in (*THESIS, *KINDS)}


def find(name: str) -> Entry:
    """Return the table of that number or name; UserError with the known ones if there is none."""
    if name not in TABLES:
        raise UserError(f'unknown table "{name}": {suggestion(name, TABLES)}')
    return TABLES[name]


def list_tables() -> list[str]:
    """Return a line for each table: its number or name, and its title."""
    width = max(map(len, TABLES))
    return [f"{entry.name:<{width}}  {entry.title}" for entry in TABLES.values()]
