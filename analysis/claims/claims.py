"""What is claimed, and by which tests: the file `thesis.toml` of this folder, which explains its words.

Claim    a statement about a figure, the study that it is tested on, its tests (none: `why` not)
Test     a kind (a word of the file, as "higher"), two sides at most, and the numbers that it needs
Side     the runs that are meant: agent, study, environment, and values of hyperparameters
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any

from sweep.messages import UserError, suggestion

WINDOWS: Mapping[str, tuple[float, float]] = {"all": (0.0, 1.0), "first half": (0.0, 0.5), "last tenth": (0.9, 1.0)}
SECOND: Mapping[str, str] = {
    "higher": "than",
    "similar": "to",
    "at_least": "as",
    "narrower": "than",
    "loses_less": "than",
}
"""Kind → the word of its second side."""
ALONE = ("above", "below", "falls_from", "dominated")
WIDTHS = ("narrower", "dominated")
"""Kinds about the widths of sensitivity regions; the others are about mean returns."""
KINDS = (*SECOND, *ALONE)


@dataclass(frozen=True)
class Side:
    """Runs of an agent in a study, on an environment (None: on each), with these values of hyperparameters."""

    agent: str
    study: str
    environment: str | None = None
    where: Mapping[str, Any] = field(default_factory=dict)

    def text(self, context: "Side | None" = None) -> str:
        """Return the runs in words, without what `context` says as well."""
        parts = [f"{name} = {value}" for name, value in self.where.items()]
        if context is not None and self.environment != context.environment:
            parts.append(str(self.environment))
        if context is not None and self.study != context.study:
            parts.append(self.study)
        return f"{self.agent} ({', '.join(parts)})" if parts else self.agent


@dataclass(frozen=True)
class Test:
    """A test of a claim. `window`, `earlier`: parts of the steps; `bound`: of "above" and "below"; `at`: critic step-sizes."""

    kind: str
    first: Side
    second: Side | None = None
    window: tuple[float, float] = (0.0, 1.0)
    earlier: tuple[float, float] | None = None
    bound: float | None = None
    at: tuple[float, ...] = ()


@dataclass(frozen=True)
class Claim:
    """A statement about a figure; `name` is the figure and a number, as "6.1.2"."""

    name: str
    figure: str
    study: str
    statement: str
    tests: tuple[Test, ...]
    why: str = ""


@dataclass(frozen=True)
class Claims:
    """All claims of a file, with the margin of "similar" and the highest return of each environment."""

    claims: tuple[Claim, ...]
    margin: float
    best_returns: Mapping[str, float]


@cache
def thesis_claims() -> Claims:
    """Return the claims of the thesis' chapters 6 and 7."""
    return parse_claims(resources.files("analysis.claims").joinpath("thesis.toml").read_text(encoding="utf-8"))


def thesis_studies() -> list[str]:
    """Return the studies that these claims are about, in their order."""
    return list(dict.fromkeys(claim.study for claim in thesis_claims().claims))


def parse_claims(text: str) -> Claims:
    """Return the claims of a file's text. Raises UserError for a test that cannot be understood."""
    content = tomllib.loads(text)
    counts: dict[str, int] = {}
    claims = []
    for table in content["claim"]:
        figure = str(table["figure"])
        counts[figure] = counts.get(figure, 0) + 1
        name = f"{figure}.{counts[figure]}"
        tests = tuple(_test(test, table["study"], name) for test in table["tests"])
        claims.append(Claim(name, figure, table["study"], table["statement"], tests, table.get("why", "")))
    return Claims(tuple(claims), float(content["margin"]), content["best_returns"])


def _test(table: Mapping[str, Any], study: str, claim: str) -> Test:
    kinds = [word for word in table if word in KINDS]
    if len(kinds) != 1:
        raise UserError(f"claim {claim}: a test needs one of {', '.join(KINDS)}, and has {', '.join(kinds) or 'none'}")
    (kind,) = kinds
    environment = table.get("environment")
    known = {"environment", "window", "at", "agent", kind, SECOND.get(kind, kind)}
    for word in table:
        if word not in known:
            raise UserError(f'claim {claim}: unknown word "{word}": {suggestion(word, known)}')
    first = table["agent"] if kind in ("above", "below", "falls_from") else table[kind]
    return Test(
        kind,
        _side(first, study, environment),
        _side(table[SECOND[kind]], study, environment) if kind in SECOND else None,
        _window(table.get("window", "all"), claim),
        _window(table["falls_from"], claim) if kind == "falls_from" else None,
        float(table[kind]) if kind in ("above", "below") else None,
        tuple(map(float, table.get("at", ()))),
    )


def _side(said: Any, study: str, environment: str | None) -> Side:
    if isinstance(said, str):
        return Side(said, study, environment)
    where = {name: value for name, value in said.items() if name not in ("agent", "study", "environment")}
    return Side(said["agent"], said.get("study", study), said.get("environment", environment), where)


def _window(said: Any, claim: str) -> tuple[float, float]:
    if isinstance(said, str) and said not in WINDOWS:
        raise UserError(f'claim {claim}: unknown window "{said}": {suggestion(said, WINDOWS)}')
    low, high = WINDOWS[said] if isinstance(said, str) else map(float, said)
    if not 0 <= low < high <= 1:
        raise UserError(f"claim {claim}: a window is a part of the steps, as [0.4, 0.5], and this one is [{low}, {high}]")
    return low, high
