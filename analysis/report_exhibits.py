"""The figures and tables of a report: all of the catalogue that a study has data for, each with the checksum of its data.

What carries a number of the thesis is shown of the study that it was made for (or of its small version) alone; the kinds are
shown of every study, and what shows the choices of one rule once for each rule that the study asks for. What would show the same
twice is left out: an exhibit with the same data, and a kind that numbered ones show of all environments.
"""

import base64
import hashlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import duckdb
import pandas as pd

from analysis.analyze import Entry, everything, needs_store
from analysis.claims.claims import thesis_studies
from analysis.figures.catalogue import Entry as FigureEntry
from analysis.figures.drawing import Drawing
from analysis.figures.options import REGIMES, NoDataError
from analysis.query import short_message
from analysis.tables.table import Table
from sweep.messages import UserError

_PIXELS = 96
"""Pixels an inch, of a page."""
_LARGEST_DRAWING = 400_000
"""Bytes of a figure as lines; one with more is shown as pixels."""
_DISPLAY_NAMES = {
    "figure setting-ecdf": "Distribution over settings",
    "figure importance": "Importance of hyperparameters",
    "table importance": "Shares of variance",
}
"""Labels → names, of kinds whose name does not say it, or names a figure and a table alike."""
_EVALUATIONS = "SELECT 1 FROM evaluations WHERE trial IN (SELECT trial FROM members WHERE study = ?) LIMIT 1"


@dataclass(frozen=True)
class Exhibit:
    """A figure or a table of a study.

    `label`: "figure 7.1"; it is numbered by the thesis, or bears the name of its kind. `rule`: the rule of choice that it shows,
    "" where there is none. `csv`: the bytes that `sweep analyze --format csv` writes, `sha256` their checksum. `image`: a figure
    as a data: link, None for a table; `width` and `height` are its pixels on a page.
    """

    label: str
    kind: str
    is_numbered: bool
    title: str
    caption: str
    rule: str
    notes: list[str]
    data: pd.DataFrame
    csv: bytes
    sql: str
    image: str | None = None
    width: int = 0
    height: int = 0
    sha256: str = field(default="", init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sha256", hashlib.sha256(self.csv).hexdigest())

    @property
    def name(self) -> str:
        """What readers call it: "Figure 7.1", "Learning curve"."""
        return display_name(self.label)

    @property
    def anchor(self) -> str:
        """The name of its place on the page."""
        parts = (self.label, self.rule)
        return "-".join(part for part in parts if part).replace(" ", "-").replace(".", "-")


@dataclass(frozen=True)
class LeftOut:
    """A figure or table that the study has no data for, and why."""

    label: str
    title: str
    reason: str

    @property
    def name(self) -> str:
        """What readers call it."""
        return display_name(self.label)


def display_name(label: str) -> str:
    """Return a label as readers want it: "figure 7.1" is Figure 7.1, "table tuned-settings" is Tuned settings."""
    what, _, name = label.partition(" ")
    name, *rule = name.split(" ", 1)
    known = _DISPLAY_NAMES.get(label.removesuffix(f" {rule[0]}") if rule else label)
    is_numbered = any(character.isdigit() for character in name)
    shown = known or (f"{what.capitalize()} {name}" if is_numbered else name.replace("-", " ").capitalize())
    return " ".join([shown, *rule])


def exhibits(
    connection: duckdb.DuckDBPyConnection,
    study: str,
    environments: Sequence[str],
    rules: Sequence[str],
    seed: int,
    pictures: bool = True,
    say: Callable[[str], None] = lambda news: None,
) -> tuple[list[Exhibit], list[LeftOut]]:
    """Return what the study has data for and what not, in the order of the catalogue.

    `environments`: of the study; `rules`: by which it chooses settings, () where all choose the same. `seed`: of bootstraps and
    permutations. Without `pictures` figures are drawn, for their data, but not rendered. Raises UserError when a query fails.
    """
    shown: list[Exhibit] = []
    left_out: list[LeftOut] = []
    has_evaluations = bool(connection.execute(_EVALUATIONS, [study]).fetchall())
    for entry, rule in _wanted(study, rules):
        label = f"{'figure' if isinstance(entry, FigureEntry) else 'table'} {entry.name}"
        say(label)
        try:
            if entry.kind == "evaluation_curve" and not has_evaluations:
                raise NoDataError("no evaluation episodes beside the learning (`study.evaluation` of the grid)")
            if not entry.studies and (numbered := _numbered(shown, entry.kind, environments)):
                raise NoDataError(f"shown as {numbered}")
            made = _make(connection, entry, study, rule, seed)
            if made.data.empty:
                raise NoDataError("the study has no data for it yet")
        except UserError as error:  # no data, too few runs, a normalizer that is undefined here
            left_out.append(LeftOut(label + (f" ({rule})" if rule else ""), entry.title, str(error)))
            continue
        except duckdb.Error as error:
            raise UserError(f"{label}: {short_message(error)}") from None
        one = _exhibit(label, entry, rule, made, pictures)
        same = next((known for known in shown if (known.kind, known.sha256) == (one.kind, one.sha256)), None)
        if same is None:
            shown.append(one)
        elif same.label != label:
            left_out.append(LeftOut(label, entry.title, f"shows the same as {same.name}"))
    return shown, left_out


def _numbered(shown: Sequence[Exhibit], kind: str, environments: Sequence[str]) -> str:
    """Return the names of the exhibits of a kind, if together they show all environments; else ""."""
    known = [one for one in shown if one.kind == kind and one.is_numbered]
    covered = {place for one in known if "environment" in one.data for place in one.data["environment"]}
    return ", ".join(one.name for one in known) if covered.issuperset(environments) and environments else ""


def _wanted(study: str, rules: Sequence[str]) -> Iterator[tuple[Entry, str]]:
    """Yield figures and tables, with the rule to ask for, "" where the entry leaves no choice."""
    for entry in everything():
        if entry.kind == "claims" and study not in thesis_studies():
            continue
        if not needs_store(entry) or (entry.studies and study.removeprefix("small-") not in entry.studies):
            continue
        # tables put several rules side by side, unless their entry asks for one
        is_of_one_rule = isinstance(entry, FigureEntry) or entry.options.by is not None or len(rules) == 1
        # unasked, it shows all of a few settings, and the choice by the first rule otherwise
        is_answered = entry.kind == "evaluation_curve" and list(rules) == [REGIMES[0]]
        if not entry.studies and is_of_one_rule and "by" in entry.load().TAKES and not is_answered and rules:
            yield from ((entry, rule) for rule in REGIMES if rule in rules)
        else:
            yield entry, ""


def _make(connection: duckdb.DuckDBPyConnection, entry: Entry, study: str, rule: str, seed: int) -> Drawing | Table:
    module = entry.load()
    title = f"{entry.title}, tuned {rule.replace('-', ' ')}" if rule else entry.title
    options = entry.options.but(title=title, by=rule or None, seed=seed)
    made: Drawing | Table = (module.draw if isinstance(entry, FigureEntry) else module.build)(connection, study, options)
    return made


def _exhibit(label: str, entry: Entry, rule: str, made: Drawing | Table, pictures: bool) -> Exhibit:
    image, width, height = None, 0, 0
    with tempfile.TemporaryDirectory() as folder:
        made.save(Path(folder, "csv"), "csv")
        csv = Path(folder, "csv").read_bytes()
        if isinstance(made, Drawing):
            width, height = (round(float(inches) * _PIXELS) for inches in made.figure.get_size_inches())
            image = _image(made, Path(folder)) if pictures else None
    return Exhibit(
        label=label,
        kind=entry.kind,
        is_numbered=bool(entry.studies),
        title=entry.title,
        caption=entry.caption,
        rule=rule,
        notes=list(made.notes),
        data=made.data,
        csv=csv,
        sql=made.sql.strip(),
        image=image,
        width=width,
        height=height,
    )


def _image(drawing: Drawing, folder: Path) -> str:
    """Return the figure as a data: link, of lines as long as these are not too many.

    In an image of its own, nothing in the drawing can act on the page, and names within it cannot meet those of others.
    """
    drawing.save(folder / "svg", "svg")
    type, content = "image/svg+xml", (folder / "svg").read_bytes()
    if len(content) > _LARGEST_DRAWING:
        drawing.save(folder / "png", "png")
        type, content = "image/png", (folder / "png").read_bytes()
    return f"data:{type};base64,{base64.b64encode(content).decode()}"
