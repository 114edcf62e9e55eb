"""P-values of many tests, corrected for there being many.

holm                bounds the probability of any false finding (Holm 1979); needs no assumption, and beats Bonferroni always
benjamini_hochberg  bounds the expected share of false findings among the findings (Benjamini and Hochberg 1995)
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from analysis.statistics.samples import Array, check_name, take
from sweep.messages import UserError

CORRECTIONS = ("holm", "benjamini_hochberg")


def correct(p_values: ArrayLike, method: str = "holm") -> Array:
    """Return the adjusted p-values [m] of m tests: compare them with the level as they are.

    Raises UserError for an unknown method and for values that are no p-values.
    """
    check_name(method, CORRECTIONS, "correction")
    given = take(p_values, "p-values")
    if np.any((given < 0) | (given > 1)):
        raise UserError("p-values: all lie between 0 and 1")
    if not len(given):
        return given
    if method == "benjamini_hochberg":
        return np.asarray(stats.false_discovery_control(given, method="bh"))
    order = np.argsort(given, kind="stable")
    # the smallest is multiplied by m, the next by m − 1, …; none may come out below a smaller one
    stepped = np.maximum.accumulate(given[order] * np.arange(len(given), 0, -1))
    adjusted = np.empty_like(given)
    adjusted[order] = np.minimum(stepped, 1)
    return adjusted
