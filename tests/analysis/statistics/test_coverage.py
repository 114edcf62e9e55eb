"""How often intervals cover the truth: the table of docs/statistics.md, measured again."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.bands import simultaneous_band
from analysis.statistics.intervals import interval_ends
from analysis.statistics.tolerance import tolerance_interval

DOCUMENT = Path(__file__).parents[3] / "docs" / "statistics.md"
METHODS = {"Student": "student", "percentile": "percentile", "BCa": "bca", "± 1 standard error": "standard_error"}
COLUMNS = [*METHODS, "tolerance"]
ROW = re.compile(r"^\| (normal|log-normal|20 % collapse) \| (\d+) \|(.*)\|$", re.MULTILINE)
DATA_SETS = 6_000
COLLAPSED = 0.2  # of runs, at −10 instead of 0, both with standard deviation 1


def draw(rng, shape, data):
    if data == "normal":
        return rng.normal(size=shape)
    if data == "log-normal":
        return rng.lognormal(size=shape)
    return rng.normal(size=shape) - 10 * (rng.random(shape) < COLLAPSED)


def true_mean(data):
    return {"normal": 0.0, "log-normal": np.exp(0.5), "20 % collapse": -10 * COLLAPSED}[data]


def share_below(score, data):
    """The distribution function that `draw` draws from."""
    if data == "log-normal":
        return stats.lognorm.cdf(score, 1)
    if data == "normal":
        return stats.norm.cdf(score)
    return COLLAPSED * stats.norm.cdf(score + 10) + (1 - COLLAPSED) * stats.norm.cdf(score)


def measure(data, num_runs, seed):
    """Percent of data sets whose interval covers: the mean, and for tolerance the share that is attained with 95 %."""
    samples = draw(np.random.default_rng(seed), (DATA_SETS, num_runs), data)
    covered = []
    for method in METHODS.values():
        low, high = interval_ends(samples, method, resamples=1_500, seed=seed)
        covered.append(np.mean((low <= true_mean(data)) & (true_mean(data) <= high)))
    intervals = [tolerance_interval(sample) for sample in samples]
    held = [share_below(each.high, data) - share_below(each.low, data) >= each.attained_beta for each in intervals]
    return 100 * np.array([*covered, np.mean(held)])


def documented():
    rows = {(data, int(num_runs)): cells for data, num_runs, cells in ROW.findall(DOCUMENT.read_text())}
    return {key: [float(cell) for cell in cells.split("|")] for key, cells in rows.items()}


def test_the_table_has_every_kind_of_data_every_number_of_runs_and_every_method():
    table = documented()
    assert set(table) == {(data, n) for data in ("normal", "log-normal", "20 % collapse") for n in (3, 5, 10, 30)}
    assert all(len(cells) == len(COLUMNS) for cells in table.values())
    assert f"| data | n | {' | '.join(COLUMNS)} |" in DOCUMENT.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("data", ["normal", "log-normal", "20 % collapse"])
@pytest.mark.parametrize("num_runs", [3, 5, 10, 30])
def test_intervals_cover_as_often_as_documented(data, num_runs):
    # the standard error of a coverage is at most 0.65 points here, and 0.8 with that of the document
    np.testing.assert_allclose(measure(data, num_runs, seed=1), documented()[data, num_runs], rtol=0, atol=2.4)


@pytest.mark.slow
@pytest.mark.parametrize("num_runs", [5, 30])
def test_a_simultaneous_band_covers_the_whole_curve_about_as_often_as_it_says(num_runs):
    rng = np.random.default_rng(2)
    covered = 0
    for _ in range(1_000):
        curves = rng.normal(size=(num_runs, 50)).cumsum(1)
        found = simultaneous_band(curves, resamples=500, seed=int(rng.integers(2**31)))
        covered += bool(np.all((found.low <= 0) & (found.high >= 0)))
    stated = re.search(rf"(\d+) % of curves at n = {num_runs}\b", " ".join(DOCUMENT.read_text().split()))
    assert stated, "docs/statistics.md says it"
    assert 100 * covered / 1_000 == pytest.approx(float(stated[1]), abs=3)
