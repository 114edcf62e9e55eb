"""Linear combinations of the means of independent groups of runs: Σ wᵢ·x̄ᵢ, with Welch's and Satterthwaite's interval.

A difference of two means is the contrast with weights 1 and −1, and its interval is Welch's. Sources: Satterthwaite 1946,
*Biometrics Bulletin* 2; Welch 1947, *Biometrika* 34.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from analysis.statistics.estimate import Estimate, need_runs
from analysis.statistics.samples import check_share, take_runs
from sweep.messages import UserError


@dataclass(frozen=True)
class Contrast:
    """A contrast: its value, standard error, degrees of freedom, and the runs of the smallest group."""

    value: float
    standard_error: float
    degrees: float
    num_runs: int

    def interval(self, confidence: float = 0.95) -> Estimate:
        """Return the two-sided interval; UserError for a confidence that is not between 0 and 1."""
        check_share(confidence, "confidence")
        reach = self.standard_error * float(stats.t.ppf((1 + confidence) / 2, self.degrees)) if self.standard_error else 0.0
        return Estimate(self.value, self.value - reach, self.value + reach, confidence, "Welch–Satterthwaite", self.num_runs)

    def p_above(self, bound: float) -> float:
        """Return the one-sided p-value of the claim that the contrast exceeds `bound`: small where it does."""
        if self.standard_error == 0:
            return float(self.value <= bound)
        return float(stats.t.sf((self.value - bound) / self.standard_error, self.degrees))

    def p_below(self, bound: float) -> float:
        """Return the one-sided p-value of the claim that the contrast is less than `bound`."""
        if self.standard_error == 0:
            return float(self.value >= bound)
        return float(stats.t.cdf((self.value - bound) / self.standard_error, self.degrees))


def contrast(groups: Sequence[ArrayLike], weights: Sequence[float]) -> Contrast:
    """Return Σ wᵢ·(mean of group i), groups [n₁], [n₂], …; UserError unless there is a weight for each group.

    Raises TooFewRunsError (UserError) for a group of fewer than two runs, UserError for NaN.
    """
    if len(groups) != len(weights) or not groups:
        raise UserError(f"a contrast needs a weight for each group, and there are {len(weights)} and {len(groups)}")
    runs = [take_runs(group, "a contrast") for group in groups]
    fewest = min(map(len, runs))
    need_runs(fewest, 2, "a contrast")
    value = sum(weight * float(group.mean()) for weight, group in zip(weights, runs, strict=True))
    parts = np.array([weight**2 * group.var(ddof=1) / len(group) for weight, group in zip(weights, runs, strict=True)])
    variance = float(parts.sum())
    spread = float((parts**2 / np.array([len(group) - 1 for group in runs])).sum())
    return Contrast(value, variance**0.5, variance**2 / spread if spread else float("inf"), fewest)
