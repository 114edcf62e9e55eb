"""`sweep report`: a study on one page: warnings, what was run, chosen settings, every figure and table, methods, a checklist.

The page is one file of HTML without scripts that asks for nothing from anywhere: `Report.html`. `Report.content` is the same as
values that JSON knows. The same store gives the same bytes.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import duckdb

from analysis.database import connect
from analysis.query import short_message
from analysis.report_checklist import Item, checklist
from analysis.report_exhibits import Exhibit, LeftOut, exhibits
from analysis.report_facts import Facts, gather
from analysis.report_methods import methods
from analysis.report_page import jsonable, records, render
from analysis.report_warnings import ReportWarning, find_warnings
from sweep.messages import UserError, suggestion
from sweep.store import Store

MOST_ROWS = 5_000
"""Rows of an exhibit that `Report.content` holds; `sweep analyze --format csv` writes them all."""


@dataclass(frozen=True)
class Report:
    """All that is said of a study. `seed`: of bootstraps and permutations."""

    facts: Facts
    seed: int
    warnings: list[ReportWarning]
    exhibits: list[Exhibit]
    left_out: list[LeftOut]

    @cached_property
    def methods(self) -> str:
        """The methods paragraph of a paper."""
        return methods(self.facts, self.seed)

    @cached_property
    def checklist(self) -> list[Item]:
        """What reviewers ask, answered."""
        return checklist(self.facts, self.warnings, len(self.exhibits))

    def html(self) -> bytes:
        """Return the page, in UTF-8."""
        return render(self).encode("utf-8", "replace")

    def content(self) -> dict[str, Any]:
        """Return everything as values that JSON knows; numbers that are not finite are null."""
        facts = {name: value for name, value in vars(self.facts).items() if name in Facts.__dataclass_fields__}
        for name in ("planned", "choices", "shown", "spreads"):
            facts.pop(name)
        exhibits = [(one, records(one.data)) for one in self.exhibits]
        content = {
            "study": self.facts.study,
            "seed": self.seed,
            "warnings": [{**asdict(one), "heading": one.heading} for one in self.warnings],
            "run": {**facts, "seeds_in_common": self.facts.overlap},
            "choices": self.facts.choices,
            "shown_by": self.facts.shown,
            "normalized_scores": self.facts.spreads,
            "exhibits": [
                {name: getattr(one, name) for name in ("label", "kind", "title", "rule", "caption", "notes", "sql", "sha256")}
                | {"num_rows": len(rows), "rows": rows[:MOST_ROWS]}
                for one, rows in exhibits
            ],
            "left_out": [asdict(one) for one in self.left_out],
            "methods": self.methods,
            "checklist": [asdict(one) for one in self.checklist],
        }
        plain: dict[str, Any] = jsonable(content)
        return plain


def report(
    path: Path, study: str, seed: int = 0, pictures: bool = True, say: Callable[[str], None] = lambda news: None
) -> Report:
    """Return what there is to say of a study of the store in a folder, however far it is.

    `pictures`: render the figures, which `Report.html` needs. `say` hears what is being drawn. Raises UserError for an unknown
    study, and where the store is none or damaged.
    """
    store = Store.open(path)
    if study not in store.studies():
        raise UserError(f'unknown study "{study}": {suggestion(study, store.studies())}')
    connection = connect(path)
    try:
        say("reading")
        facts = gather(connection, store, study)
        # with one environment, both rules choose the same
        rules = facts.by if len(facts.by) == 1 or (facts.has_choice and len(facts.environments) > 1) else []
        shown, left_out = exhibits(connection, study, facts.environments, rules, seed, pictures, say)
    except duckdb.Error as error:
        raise UserError(f"{path}: {short_message(error)}") from None
    finally:
        connection.close()
    return Report(facts, seed, find_warnings(facts), shown, left_out)
