"""Which hyperparameters a study sweeps, and their values in the order in which an axis has them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import duckdb

from analysis.figures import style
from analysis.figures.options import NoDataError, Options
from sweep.messages import UserError, suggestion

Panel = tuple[str, str]
"""Agent, environment."""
_FIRST = ("critic_step_size", "actor_step_size_scale", "entropy_scale")  # of equally much swept ones


@dataclass(frozen=True)
class Value:
    """A value of a hyperparameter: as the view `hyperparameters` writes it, and as a number (None for texts and lists)."""

    text: str
    number: float | None

    @property
    def label(self) -> str:
        """The value as a tick shows it."""
        return self.text if self.number is None else style.number(self.number)


def find_swept(connection: duckdb.DuckDBPyConnection, study: str, options: Options) -> dict[str, list[Value]]:
    """Return each hyperparameter that an agent of `options` sweeps → its values, ascending; the most swept one first.

    That is the one swept by the most agents on the most environments. Raises NoDataError if none is swept.
    """
    rows = connection.execute(
        """
        SELECT agent, environment, hyperparameter, value, number
        FROM hyperparameters
        WHERE study = ? AND is_swept
        GROUP BY agent, environment, hyperparameter, value, number
        """,
        [study],
    ).fetchall()
    found: dict[str, set[Value]] = {}
    panels: dict[str, set[Panel]] = {}
    for agent, environment, name, text, number in rows:
        if options.keeps(agent, environment):
            found.setdefault(name, set()).add(Value(text, number))
            panels.setdefault(name, set()).add((agent, environment))
    if not found:
        raise NoDataError(
            f'study "{study}" sweeps no hyperparameter' + (" there" if options.agents or options.environments else "")
        )

    def rank(name: str) -> tuple[int, int, int, str]:
        known = _FIRST.index(name) if name in _FIRST else len(_FIRST)
        return -len(panels[name]), known, -len(found[name]), name

    return {name: _ordered(found[name]) for name in sorted(found, key=rank)}


def check_swept(connection: duckdb.DuckDBPyConnection, study: str, flag: str, name: str, swept: Mapping[str, object]) -> None:
    """Raise UserError for a hyperparameter that the study's agents do not have, NoDataError for one that is not swept."""
    if name in swept:
        return
    rows = connection.execute("SELECT DISTINCT hyperparameter FROM hyperparameters WHERE study = ?", [study]).fetchall()
    known = sorted(row[0] for row in rows)
    if name not in known:
        raise UserError(f'--{flag}: unknown hyperparameter "{name}": {suggestion(name, known)}')
    raise NoDataError(f'study "{study}" does not sweep {name}; it sweeps {", ".join(swept)}')


def find_values(connection: duckdb.DuckDBPyConnection, study: str, name: str, texts: Iterable[str]) -> list[Value]:
    """Return the values of a hyperparameter that are among `texts`, swept or not, in the order of an axis."""
    rows = connection.execute(
        "SELECT DISTINCT value, number FROM hyperparameters WHERE study = ? AND hyperparameter = ?", [study, name]
    ).fetchall()
    wanted = set(texts)
    return _ordered({Value(text, number) for text, number in rows if text in wanted})


def are_numbers(values: Sequence[Value]) -> bool:
    """Return whether all values are numbers."""
    return all(value.number is not None for value in values)


def _ordered(values: set[Value]) -> list[Value]:
    """Return numbers ascending, then texts in alphabetical order."""
    return sorted(values, key=lambda value: (value.number is None, value.number or 0.0, value.text))
