"""Runs as they come in: finite numbers, enough of them, and names that exist, or a message that says what is wrong."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.statistics.estimate import need_runs
from sweep.messages import UserError, suggestion

Array = NDArray[np.float64]


def take(values: ArrayLike, what: str, axes: tuple[int, ...] = (1,)) -> Array:
    """Return the values as float64, of one of the numbers of axes that are allowed.

    Raises UserError on another number of axes, and on values that are not finite, with how many there are: what a diverged run
    counts for is decided before, not here.
    """
    array = np.asarray(values, np.float64)
    if array.ndim not in axes:
        allowed = " or ".join(map(str, axes))
        raise UserError(
            f"{what}: an array of {allowed} {'axis' if axes == (1,) else 'axes'} is needed, this one has {array.ndim}"
        )
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise UserError(
            f"{what}: {bad} of {array.size} scores {'is' if bad == 1 else 'are'} NaN or infinite; "
            "decide first what a diverged run counts for (`worst`, `drop`)"
        )
    return array


def take_runs(values: ArrayLike, what: str, least: int = 2) -> Array:
    """Return the scores of runs [n] as float64. Raises TooFewRunsError under `least`, UserError like `take`."""
    runs = take(values, what)
    need_runs(len(runs), least, what)
    return runs


def check_share(value: float, name: str) -> None:
    """Raise UserError unless a level, a share or a probability lies strictly between 0 and 1."""
    if not 0 < value < 1:
        raise UserError(f"{name}: {value:g} is not between 0 and 1")


def check_count(value: int, name: str) -> None:
    """Raise UserError unless a number of resamples is positive."""
    if value < 1:
        raise UserError(f"{name}: {value} is not positive")


def check_name(name: str, known: Iterable[str], what: str) -> None:
    """Raise UserError, with the nearest name, unless a method, a test or an aggregate is known."""
    names = list(known)
    if name not in names:
        raise UserError(f'unknown {what} "{name}"; {suggestion(name, names)}')
