"""Effect sizes: how large a difference is, beside how certain it is.

Cohen's d     difference of means / pooled standard deviation
Hedges' g     d · Γ(m/2) / (√(m/2) · Γ((m − 1)/2)), m = n₁ + n₂ − 2: d without its bias in small samples
P(X > Y)      that a run of the first is better than one of the second, ties ½: Mann–Whitney U / (n₁ n₂)
Cliff's δ     P(X > Y) − P(X < Y) = 2 P(X > Y) − 1
"""

import math
from dataclasses import dataclass

from numpy.typing import ArrayLike
from scipy import special

from analysis.statistics.aggregates import improvement
from analysis.statistics.samples import take_runs


@dataclass(frozen=True)
class EffectSizes:
    """Effect sizes of the first group against the second; positive where the first has the higher scores.

    `cohen_d` and `hedges_g` are infinite where means differ and neither group varies.
    """

    cohen_d: float
    hedges_g: float
    cliffs_delta: float
    probability_of_superiority: float


def effect_sizes(first: ArrayLike, second: ArrayLike) -> EffectSizes:
    """Return the effect sizes of two groups of runs, [n₁] and [n₂]. Raises TooFewRunsError under two runs, UserError for NaN."""
    x, y = take_runs(first, "effect size"), take_runs(second, "effect size")
    freedom = len(x) + len(y) - 2
    # deviations from the first run, so that equal runs have a spread of exactly 0
    squares = sum((len(runs) - 1) * float((runs - runs[0]).var(ddof=1)) for runs in (x, y))
    spread = math.sqrt(squares / freedom)
    difference = float(x[0] - y[0]) if spread == 0 else float(x.mean() - y.mean())
    d = difference / spread if spread else math.copysign(math.inf, difference) if difference else 0.0
    unbiased = math.exp(special.gammaln(freedom / 2) - special.gammaln((freedom - 1) / 2)) / math.sqrt(freedom / 2)
    superiority = float(improvement(x[None], y[None]))
    return EffectSizes(d, d * unbiased, 2 * superiority - 1, superiority)
