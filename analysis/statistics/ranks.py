"""Whether several algorithms differ, over environments: tests of the ranks that they have within each environment.

    friedman        every algorithm was run on every environment (Friedman 1937; `scipy.stats.friedmanchisquare`)
    skillings_mack  cells may be missing (Skillings and Mack 1981); with none missing and no ties it is Friedman's

A cell is the mean score of an algorithm on an environment. Ranks need no common scale: no normalizer is involved. With a handful
of environments the χ² distribution is rough; `p_permutation` needs no approximation but that of the number of permutations.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from analysis.statistics.bootstrap import RESAMPLES
from analysis.statistics.estimate import need_runs
from analysis.statistics.samples import Array, check_count
from sweep.messages import UserError


@dataclass(frozen=True)
class RankTest:
    """A test of several algorithms over environments.

    `p_value`: from the χ² distribution with `degrees_of_freedom`. `p_permutation`: (b + 1) / (m + 1), b the number of m random
    permutations within environments that give a statistic at least as large. `mean_ranks` [algorithms]: 1 is the best.
    """

    statistic: float
    degrees_of_freedom: int
    p_value: float
    p_permutation: float
    mean_ranks: tuple[float, ...]
    num_environments: int
    test: str
    resamples: int
    seed: int


def friedman(scores: ArrayLike, resamples: int = RESAMPLES, seed: int = 0) -> RankTest:
    """Return Friedman's test of scores [environments, algorithms].

    Raises UserError for missing cells and for fewer than three algorithms, TooFewRunsError with fewer than two environments.
    """
    table = _take_table(scores, "Friedman's test", 3)
    if np.isnan(table).any():
        raise UserError(f"Friedman's test: {int(np.isnan(table).sum())} cells are missing; `skillings_mack` does without them")
    tied = bool(np.all(table.max(1) == table.min(1)))  # there it divides 0 by 0
    statistic = 0.0 if tied else float(stats.friedmanchisquare(*table.T).statistic)
    freedom = table.shape[1] - 1
    return _result("Friedman", table, statistic, freedom, resamples, seed)


def skillings_mack(scores: ArrayLike, resamples: int = RESAMPLES, seed: int = 0) -> RankTest:
    """Return Skillings and Mack's test of scores [environments, algorithms], NaN where a cell is missing.

    Environments with a single algorithm say nothing and are left out. Ties have their mean rank; many of them make the χ² p-value
    too large, and not `p_permutation`. Raises UserError with fewer than two algorithms and where environments do not connect all
    algorithms, TooFewRunsError with fewer than two environments.
    """
    table = _take_table(scores, "Skillings and Mack's test", 2)
    table = table[(~np.isnan(table)).sum(1) >= 2]
    need_runs(len(table), 2, "Skillings and Mack's test, over environments,")
    freedom = int(np.linalg.matrix_rank(_covariance(table)))
    if freedom < table.shape[1] - 1:
        raise UserError("Skillings and Mack's test: some algorithms share no environment, directly or over others, with the rest")
    return _result("Skillings–Mack", table, float(_statistic(_centered(table).sum(0), table)), freedom, resamples, seed)


def _take_table(scores: ArrayLike, what: str, least: int) -> Array:
    table = np.asarray(scores, np.float64)
    if table.ndim != 2 or table.shape[1] < least:
        raise UserError(f"{what} compares at least {least} algorithms, scores [environments, algorithms]")
    if np.isinf(table).any():
        raise UserError(f"{what}: {int(np.isinf(table).sum())} cells are infinite")
    need_runs(len(table), 2, f"{what}, over environments,")
    return table


def _ranks(table: Array) -> Array:
    """Return ranks within each row, 1 the lowest; NaN where a cell is missing."""
    return np.asarray(stats.rankdata(table, axis=1, nan_policy="omit"))


def _centered(table: Array) -> Array:
    """Return √(12 / (k + 1)) · (rank − (k + 1) / 2), k the cells of the row; a missing cell has the mean rank, and is 0."""
    present = (~np.isnan(table)).sum(1, keepdims=True)
    return np.nan_to_num(np.sqrt(12 / (present + 1)) * (_ranks(table) - (present + 1) / 2))


def _covariance(table: Array) -> Array:
    there = (~np.isnan(table)).astype(np.float64)
    together = there.T @ there
    np.fill_diagonal(together, 0)
    return np.diag(together.sum(1)) - together


def _statistic(sums: Array, table: Array) -> Array:
    return np.asarray(np.einsum("...i,ij,...j->...", sums, np.linalg.pinv(_covariance(table), hermitian=True), sums))


def _result(test: str, table: Array, statistic: float, freedom: int, resamples: int, seed: int) -> RankTest:
    check_count(resamples, "resamples")
    rng = np.random.default_rng(seed)
    centered, sums = _centered(table), np.zeros((resamples, table.shape[1]))
    for row, here in zip(centered, ~np.isnan(table), strict=True):
        sums[:, here] += rng.permuted(np.tile(row[here], (resamples, 1)), axis=1)
    # Friedman's statistic is this one times a constant of the ties, which no permutation changes
    observed = _statistic(centered.sum(0), table)
    as_large = int(np.count_nonzero(_statistic(sums, table) >= observed - 1e-9 * (1 + observed)))
    return RankTest(
        statistic=statistic,
        degrees_of_freedom=freedom,
        p_value=float(stats.chi2.sf(statistic, freedom)),
        p_permutation=(as_large + 1) / (resamples + 1),
        mean_ranks=tuple(map(float, np.nanmean(_ranks(-table), axis=0))),
        num_environments=len(table),
        test=test,
        resamples=resamples,
        seed=seed,
    )
