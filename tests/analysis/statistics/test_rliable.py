"""Intervals and profiles against rliable's on the same data."""

import warnings

import numpy as np
import pytest

from analysis.statistics.aggregates import aggregate, probability_of_improvement
from analysis.statistics.profiles import performance_profile, sample_efficiency

FIRST, SECOND = np.random.default_rng(0).normal([[[0.7]], [[0.6]]], 0.5, size=(2, 10, 5))
THEIR_RESAMPLES = 1_000


@pytest.fixture(scope="module")
def library():
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # arch, below it, decorates a function that is not used here in a way that pandas 3 does not know any more
        patch.setattr("pandas.util._decorators.deprecate_kwarg", lambda *names, **rest: lambda function: function)
        from rliable import library
    return library


@pytest.fixture(autouse=True)
def _their_generator():
    state = np.random.get_state()  # rliable draws from the global one
    np.random.seed(0)
    yield
    np.random.set_state(state)


def close(mine, low, high, resamples=THEIR_RESAMPLES):
    # the end of a 95 % interval from B resamples has a standard error of √(0.025 · 0.975 / B) / 0.058 of that of the statistic
    off = 4 * np.sqrt(0.025 * 0.975 / resamples) / 0.058 * np.max(high - low) / 3.92
    np.testing.assert_allclose(np.ravel(mine.low), np.ravel(low), rtol=0, atol=off)
    np.testing.assert_allclose(np.ravel(mine.high), np.ravel(high), rtol=0, atol=off)


@pytest.mark.parametrize("name", ["mean", "median", "iqm", "optimality_gap"])
@pytest.mark.parametrize("tasks", [False, True])
def test_a_stratified_interval_is_rliables(library, name, tasks):
    from rliable import metrics

    theirs = getattr(metrics, f"aggregate_{name}")
    values, ends = library.get_interval_estimates(
        {"a": FIRST}, lambda scores: np.array([theirs(scores)]), reps=THEIR_RESAMPLES, task_bootstrap=tasks
    )
    mine = aggregate(FIRST, name, tasks=tasks)
    assert mine.value == pytest.approx(values["a"][0])
    close(mine, *ends["a"])


def test_the_interval_of_the_probability_of_improvement_is_rliables(library):
    from rliable import metrics

    values, ends = library.get_interval_estimates(
        {"a,b": (FIRST, SECOND[:6])}, lambda x, y: np.array([metrics.probability_of_improvement(x, y)]), reps=300
    )
    mine = probability_of_improvement(FIRST, SECOND[:6])
    assert mine.value == pytest.approx(values["a,b"][0])
    close(mine, *ends["a,b"], resamples=300)


@pytest.mark.parametrize("of", ["runs", "task_means"])
def test_a_performance_profile_is_rliables(library, of):
    thresholds = np.linspace(-0.5, 2, 9)
    profiles, ends = library.create_performance_profile(
        {"a": FIRST}, thresholds, use_score_distribution=of == "runs", reps=THEIR_RESAMPLES
    )
    mine = performance_profile(FIRST, thresholds, of, resamples=10_000)
    assert mine.value == pytest.approx(profiles["a"])
    # shares of 50 runs, or of 5 tasks, come in steps: an end may be one step off
    np.testing.assert_allclose(mine.low, ends["a"][0], atol=0.021 if of == "runs" else 0.201)
    np.testing.assert_allclose(mine.high, ends["a"][1], atol=0.021 if of == "runs" else 0.201)


def test_sample_efficiency_is_rliables(library):
    from rliable import metrics

    scores = np.random.default_rng(4).normal(np.arange(3), 1, size=(8, 5, 3))

    def iqm(scores):
        return np.array([metrics.aggregate_iqm(scores[..., checkpoint]) for checkpoint in range(3)])

    values, ends = library.get_interval_estimates({"a": scores}, iqm, reps=THEIR_RESAMPLES)
    mine = sample_efficiency(scores, "iqm", resamples=10_000)
    assert mine.value == pytest.approx(values["a"])
    close(mine, *ends["a"])
