"""A statistic with its interval, and what a reader has to know to judge it."""

from dataclasses import dataclass

from sweep.messages import UserError


class TooFewRunsError(UserError):
    """An interval or a test was asked for that so few runs cannot give."""


@dataclass(frozen=True)
class Estimate:
    """A statistic and its interval.

    `value`: computed from the data themselves, never the mean of resamples. `low`, `high`: the ends of the interval of level
    `confidence`. `method`: how it was made, in words: "Student", "percentile bootstrap", "BCa bootstrap", "stratified bootstrap".
    `num_runs`: the runs behind it (n). `resamples`, `seed`: of the bootstrap or the permutations; None where there are none.
    """

    value: float
    low: float
    high: float
    confidence: float
    method: str
    num_runs: int
    resamples: int | None = None
    seed: int | None = None


def need_runs(num_runs: int, least: int, what: str) -> None:
    """Raise TooFewRunsError unless there are at least `least` runs for `what` ("a Student interval")."""
    if num_runs < least:
        noun = "run" if num_runs == 1 else "runs"
        raise TooFewRunsError(
            f"{what} needs at least {least} runs, and there {'is' if num_runs == 1 else 'are'} {num_runs} {noun}"
        )
