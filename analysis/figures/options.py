"""What can be asked of a figure or a table beside its study: which part of the data, and how it is shown."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any

from sweep.messages import UserError, suggestion
from sweep.normalizers import NORMALIZERS

REGIMES = ("per-environment", "across-environments")
SCORES = ("episode_mean", "step_mean", "final_mean")
BANDS = ("standard-error", "student", "bootstrap", "min-max", "runs", "none")
CHOICES: Mapping[str, tuple[str, ...]] = {"by": REGIMES, "score": SCORES, "normalizer": tuple(NORMALIZERS), "band": BANDS}


class NoDataError(UserError):
    """A study has nothing that a figure or table could show."""


@dataclass(frozen=True)
class Options:
    """What is shown and how; None and () leave it to the figure.

    `by`: tuning regime, of REGIMES. `agents`, `environments`: names or globs. `x`, `over`: hyperparameters. `score`: of SCORES.
    `normalizer`: by name. `band`: what surrounds a mean, of BANDS. `where`: hyperparameter → the value that settings must have
    that have it at all. `best_runs`: show only so many runs, the best ones (thesis 3.2). `seed`: of whatever is random.
    """

    title: str = ""
    by: str | None = None
    agents: tuple[str, ...] = ()
    environments: tuple[str, ...] = ()
    x: str | None = None
    over: str | None = None
    score: str | None = None
    normalizer: str | None = None
    band: str | None = None
    where: Mapping[str, Any] = field(default_factory=dict)
    best_runs: int | None = None
    seed: int = 0

    def but(self, **changes: Any) -> "Options":
        """Return these options with some replaced; changes that are None or empty replace nothing."""
        return replace(self, **{name: value for name, value in changes.items() if value is not None and value != ()})

    def check(self, takes: Iterable[str], what: str) -> None:
        """Raise UserError for an unknown value, or for an option that `what` ("figure 7.1") does not take."""
        takes = tuple(takes)
        for name in ("by", "agents", "environments", "x", "over", "score", "normalizer", "band"):
            value = getattr(self, name)
            if not value:
                continue
            if name not in takes:
                known = ", ".join(f"--{flag(taken)}" for taken in takes if taken != "where") or "none"
                raise UserError(f"{what} takes no --{flag(name)}; it takes: {known}")
            if name in CHOICES and value not in CHOICES[name]:
                raise UserError(f'unknown {name} "{value}": {suggestion(value, CHOICES[name])}')

    def keeps(self, agent: str, environment: str) -> bool:
        """Return whether the agent and the environment are among those asked for."""
        return _matches(agent, self.agents) and _matches(environment, self.environments)


def flag(name: str) -> str:
    """Return an option's name on the command line."""
    return {"agents": "agent", "environments": "environment"}.get(name, name)


def _matches(name: str, patterns: tuple[str, ...]) -> bool:
    return not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)
