"""How many runs a comparison needs: the power of Welch's t-test, from the noncentral t distribution.

Power is the probability that a difference of that size is found at a level. Effects are in units of the runs themselves, with the
standard deviation of a run in either group; with standard deviations of 1 they are Cohen's d (Cohen 1988; Colas et al. 2018 do
this for learning algorithms). Normal runs are assumed: scores of runs that sometimes collapse need more.
"""

import math

from scipy import stats

from analysis.statistics.estimate import need_runs
from analysis.statistics.samples import check_share
from sweep.messages import UserError

_MOST_RUNS = 10_000_000


def welch_power(
    difference: float,
    runs: int | tuple[int, int],
    deviation: float | tuple[float, float] = 1.0,
    alpha: float = 0.05,
) -> float:
    """Return the power of a two-sided Welch test of two groups of `runs` each, whose means differ by `difference`.

    `runs` and `deviation` (standard deviation of a run) are one number for both groups or one for each. Raises TooFewRunsError
    under two runs, UserError on a deviation that is not positive.
    """
    check_share(alpha, "alpha")
    first, second = runs if isinstance(runs, tuple) else (runs, runs)
    need_runs(min(first, second), 2, "Welch's t-test")
    error, freedom = _error(first, second, *_deviations(deviation))
    shift = abs(difference) / error
    critical = float(stats.t.isf(alpha / 2, freedom))
    if shift > critical + 40:
        return 1.0  # where the noncentral t is not computed well any more
    return float(stats.nct.sf(critical, freedom, shift) + stats.nct.cdf(-critical, freedom, shift))


def runs_to_detect(
    difference: float, deviation: float | tuple[float, float] = 1.0, power: float = 0.8, alpha: float = 0.05
) -> int:
    """Return how many runs each of two groups needs for a two-sided Welch test to have that power.

    64 for a difference of half a standard deviation. Raises UserError for no difference at all, and where it is so small that
    more than ten million runs are needed.
    """
    check_share(power, "power")
    if difference == 0 or not math.isfinite(difference):
        raise UserError(f"difference: {difference:g}; no number of runs detects that, name the smallest one that matters")
    low, high = 1, 2
    while welch_power(difference, high, deviation, alpha) < power:
        low, high = high, 2 * high
        if high > _MOST_RUNS:
            raise UserError(f"difference: {difference:g} is so small that over {_MOST_RUNS:,} runs are needed")
    while high - low > 1:
        middle = (low + high) // 2
        if welch_power(difference, middle, deviation, alpha) >= power:
            high = middle
        else:
            low = middle
    return high


def _deviations(deviation: float | tuple[float, float]) -> tuple[float, float]:
    both = deviation if isinstance(deviation, tuple) else (deviation, deviation)
    if not all(math.isfinite(each) and each > 0 for each in both):
        raise UserError(f"deviation: {deviation} is not positive")
    return both


def _error(first: int, second: int, deviation_first: float, deviation_second: float) -> tuple[float, float]:
    """Return the standard error of the difference, and its degrees of freedom (Welch and Satterthwaite)."""
    a, b = deviation_first**2 / first, deviation_second**2 / second
    return math.sqrt(a + b), (a + b) ** 2 / (a**2 / (first - 1) + b**2 / (second - 1))
