"""Tolerance intervals: between which scores most runs of an algorithm lie, and not where their mean does.

An (α, β) tolerance interval contains at least a share β of all runs that there could be, with confidence 1 − α. Without an
assumption about the distribution it reaches from one order statistic to another: between the l-th and the u-th smallest of n runs
lies a share that has the distribution Beta(u − l, n − u + l + 1) (Wilks 1941), exactly for continuous scores, and at least that
with ties. Patterson et al. recommend it for showing how runs vary.

From few runs no interval attains what is asked. Then this one reaches from the lowest run to the highest and says what it does
attain: the confidence for the share that was asked for, and the share for the confidence that was asked for.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from analysis.statistics.samples import check_share, take_runs


@dataclass(frozen=True)
class ToleranceInterval:
    """An interval that contains a share of runs. `alpha` and `beta` were asked for; `attained_…` is what holds.

    `low`, `high`: the order statistics `low_rank` and `high_rank` (1 = lowest). It contains the share `beta` with
    `attained_confidence`, and the share `attained_beta` with confidence 1 − `alpha`.
    """

    low: float
    high: float
    alpha: float
    beta: float
    attained_confidence: float
    attained_beta: float
    num_runs: int
    low_rank: int
    high_rank: int

    @property
    def holds(self) -> bool:
        """Whether it attains what was asked for."""
        return self.attained_confidence >= 1 - self.alpha

    def describe(self) -> str:
        """Return in words what it attains, "contains a share 0.9 of runs with confidence 0.976", or what it falls short of."""
        asked = f"{self.beta:.3g}"
        if self.holds:
            return f"contains a share {asked} of runs with confidence {self.attained_confidence:.3f}"
        return (
            f"lowest to highest of {self.num_runs} runs: contains a share {asked} of runs with confidence "
            f"{self.attained_confidence:.3f} only, and a share {self.attained_beta:.3f} with {1 - self.alpha:.3g}; "
            f"{runs_needed(self.alpha, self.beta)} runs are needed"
        )


def tolerance_interval(runs: ArrayLike, alpha: float = 0.05, beta: float = 0.9) -> ToleranceInterval:
    """Return the shortest tolerance interval in ranks that attains (alpha, beta), or lowest to highest where none does.

    As many runs are left out below as above; of an odd number, one more above, since low scores are what it is there to show.
    Raises TooFewRunsError with fewer than two runs, UserError for NaN and levels that are not between 0 and 1.
    """
    ordered = np.sort(take_runs(runs, "tolerance interval"))
    num_runs = len(ordered)
    span = np.arange(1, num_runs)  # u − l
    enough = span[_confidence(span, num_runs, alpha, beta) >= 1 - alpha]
    width = int(enough[0]) if len(enough) else num_runs - 1
    left_out = num_runs - 1 - width
    low_rank = 1 + left_out // 2
    return ToleranceInterval(
        low=float(ordered[low_rank - 1]),
        high=float(ordered[low_rank + width - 1]),
        alpha=alpha,
        beta=beta,
        attained_confidence=float(_confidence(width, num_runs, alpha, beta)),
        attained_beta=float(stats.beta.ppf(alpha, width, num_runs - width + 1)),
        num_runs=num_runs,
        low_rank=low_rank,
        high_rank=low_rank + width,
    )


def runs_needed(alpha: float = 0.05, beta: float = 0.9) -> int:
    """Return how many runs the interval from the lowest to the highest needs to attain (alpha, beta): 46 for (0.05, 0.9).

    The least n with 1 − n·β^(n−1) + (n − 1)·β^n ≥ 1 − α. Raises UserError for levels that are not between 0 and 1.
    """
    check_share(alpha, "alpha")
    check_share(beta, "beta")
    low, high = 1, 2  # one run never suffices
    while _confidence(high - 1, high, alpha, beta) < 1 - alpha:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        if _confidence(middle - 1, middle, alpha, beta) >= 1 - alpha:
            high = middle
        else:
            low = middle
    return high


def _confidence(width: ArrayLike, num_runs: int, alpha: float, beta: float) -> np.ndarray:
    check_share(alpha, "alpha")
    check_share(beta, "beta")
    # of n runs, those that fall within a fixed share β of the distribution are Binomial(n, β)
    return np.asarray(stats.binom.cdf(np.asarray(width) - 1, num_runs, beta))
