"""Functional ANOVA, against tables by hand, projections on orthogonal spaces, mean squares, and simulations."""

import itertools

import numpy as np
import pytest

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.importance import Importance, decompose
from sweep.messages import UserError

TWO = {"x": [0, 0, 1, 1], "y": [0, 1, 0, 1]}


def settings(*shape: int) -> dict[str, list[int]]:
    """Return the hyperparameters a, b, … of a full grid, the last one fastest."""
    cells = list(itertools.product(*map(range, shape)))
    return {name: [cell[axis] for cell in cells] for axis, name in enumerate("abcd"[: len(shape)])}


def runs(means: list[float], spread: float = 0.0) -> np.ndarray:
    """Return two seeds: no noise, or ± spread that all settings share."""
    return np.array(means, float)[:, None] + spread * np.array([1, -1])


def shares(found: Importance) -> dict[str, float]:
    return {component.label: component.share.value for component in found.components}


@pytest.mark.parametrize("luck", [0, 1_000])
def test_a_pure_main_effect_is_all_of_the_variance(luck):
    found = decompose(runs([0, 0, 2, 2], luck), TWO, seed=0)
    assert shares(found) == pytest.approx({"x": 1, "y": 0, "x × y": 0})
    assert (found.variance, found.noise_variance) == pytest.approx((1, 0))


def test_a_pure_interaction_is_no_main_effect():
    assert shares(decompose(runs([0, 2, 2, 0]), TWO, seed=0)) == pytest.approx({"x": 0, "y": 0, "x × y": 1})


def test_one_hyperparameter_has_all_of_the_variance():
    found = decompose(runs([0, 3, 9]), {"x": [1, 2, 4], "batch_size": [32, 32, 32]}, seed=0)
    assert shares(found) == {"x": 1}
    assert found.variance == pytest.approx(14)


def test_an_additive_function_has_the_variances_of_its_terms():
    hypers = settings(2, 3, 2)
    a, b, c = (np.array(hypers[name]) for name in "abc")
    found = decompose(runs(10 * a + np.array([0, 3, 9])[b] + c), hypers, seed=0)
    # variances 25, 14 (0, 3, 9: mean 4) and 1/4
    assert {part.label: part.variance for part in found.components} == pytest.approx(
        {"a": 25, "b": 14, "c": 0.25, "a × b": 0, "a × c": 0, "b × c": 0, "higher interactions": 0}, abs=1e-9
    )
    assert [part.label for part in found.components][:3] == ["a", "b", "c"]


def test_components_are_the_projections_on_orthogonal_spaces():
    shape = (3, 2, 4)
    means = np.random.default_rng(0).normal(size=np.prod(shape))
    found = {part.factors: part for part in decompose(runs(means), settings(*shape), seed=0).components}
    average = [np.full((levels, levels), 1 / levels) for levels in shape]
    for subset in [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)]:
        factors = [np.eye(len(m)) - m if axis in subset else m for axis, m in enumerate(average)]
        projection = np.kron(np.kron(factors[0], factors[1]), factors[2])
        names = tuple("abc"[axis] for axis in subset) if len(subset) < 3 else ()
        assert found[names].variance == pytest.approx(np.mean((projection @ means) ** 2))
        assert found[names].degrees_of_freedom == round(np.trace(projection))
    assert sum(part.share.value for part in found.values()) == pytest.approx(1)


def test_noise_is_removed_as_by_mean_squares():
    generator = np.random.default_rng(1)
    scores = generator.normal(size=(6, 5)) + generator.normal(size=5)
    found = {part.label: part.variance for part in decompose(scores, settings(2, 3), seed=0).components}
    residuals = scores - scores.mean(axis=1, keepdims=True) - scores.mean(axis=0) + scores.mean()
    error = (residuals**2).sum() / (5 * 4)
    rows = scores.reshape(2, 3, 5).mean(axis=(1, 2))
    mean_square = 3 * 5 * ((rows - rows.mean()) ** 2).sum() / 1
    assert found["a"] == pytest.approx((mean_square - error) * 1 / (5 * 6))


def test_without_an_effect_components_are_zero_on_average():
    generator = np.random.default_rng(2)
    deviations = np.linspace(0.1, 3, 12)[:, None]  # some settings are far noisier than others
    found = [
        decompose(
            deviations * generator.normal(size=(12, 4)) + generator.normal(0, 9, size=4), settings(3, 2, 2), resamples=2, seed=0
        )
        for _ in range(400)
    ]
    labels = [part.label for part in found[0].components]
    for label in labels:
        variances = np.array([next(part.variance for part in one.components if part.label == label) for one in found])
        assert abs(variances.mean()) < 4 * variances.std() / np.sqrt(len(found))
        assert variances.min() < 0  # negative estimates are kept
    assert all(set(one.negative) == {part.label for part in one.components if part.variance < 0} for one in found)


def test_noise_is_not_called_an_interaction():
    generator = np.random.default_rng(3)
    hypers = settings(5, 6)
    means = 3.0 * np.array(hypers["a"])
    found = [decompose(means[:, None] + generator.normal(0, 3, size=(30, 3)), hypers, resamples=2, seed=0) for _ in range(100)]
    assert np.mean([shares(one)["a × b"] for one in found]) == pytest.approx(0, abs=0.01)
    assert np.mean([shares(one)["a"] for one in found]) == pytest.approx(1, abs=0.01)


def test_intervals_are_about_the_estimate_and_cover_the_truth():
    generator = np.random.default_rng(4)
    hypers = settings(4, 5)
    means = np.array(hypers["a"]) + 0.5 * np.array(hypers["b"])
    truth = 1.25 / (1.25 + 0.5)
    found = [decompose(means[:, None] + generator.normal(size=(20, 10)), hypers, resamples=200, seed=0) for _ in range(60)]
    main = [next(part.share for part in one.components if part.label == "a") for one in found]
    assert np.mean([share.low <= truth <= share.high for share in main]) > 0.8
    assert np.mean([share.low for share in main]) < truth < np.mean([share.high for share in main])
    assert np.mean([(share.low + share.high) / 2 - share.value for share in main]) == pytest.approx(0, abs=0.02)
    assert (main[0].num_runs, main[0].resamples, main[0].seed) == (10, 200, 0)


def test_settings_that_differ_by_noise_alone_have_no_shares():
    scores = np.array([[1.0, -1], [-1, 1], [1, -1], [-1, 1]])
    found = decompose(scores, TWO, seed=0)
    assert not found.shares_defined
    assert np.isnan(list(shares(found).values())).all()
    assert found.variance < 0
    assert found.undefined_resamples > 0


def test_hyperparameters_that_vary_together_are_one_component():
    zipped = {"x": [1, 1, 2, 2, 2, 2], "kappa": [1, 1, 1, 1, 2, 2], "tau": [0, 1] * 3}
    with pytest.raises(UserError, match="2 of 8 combinations of x, kappa, tau are no settings: x = 1, kappa = 2, tau = 0; x = 1"):
        decompose(np.ones((6, 2)), zipped, seed=0)
    found = decompose(runs([0, 0, 3, 3, 9, 9]), zipped, together=[("x", "kappa")], seed=0)
    assert shares(found) == pytest.approx({"x & kappa": 1, "tau": 0, "x & kappa × tau": 0})


def test_the_top_settings_are_told_apart_and_the_others_are_not():
    hypers = settings(2, 4)  # b matters where a = 1; everything else failed in different ways
    means = [-90, -10, -50, -70, 10, 20, 30, 40]
    assert shares(decompose(runs(means), hypers, seed=0))["a"] > 0.7
    capped = decompose(runs(means), hypers, top=0.5, seed=0)
    by_hand = decompose(runs([10] * 4 + [10, 20, 30, 40]), hypers, seed=0)
    assert shares(capped) == pytest.approx(shares(by_hand))
    assert capped.top == 0.5
    assert "best 50% of settings" in capped.method


def test_settings_that_are_not_told_apart_carry_no_noise():
    scores = np.random.default_rng(0).normal(size=(8, 5)) + 100 * np.arange(8)[:, None]
    whole, top = (decompose(scores, settings(2, 4), top=top, seed=0) for top in (1, 0.25))
    assert top.noise_variance == pytest.approx(whole.noise_variance / 4)


def test_bad_requests_are_refused():
    with pytest.raises(UserError, match="1 of 4 combinations of x, y are no settings: x = 1, y = 1"):
        decompose(np.ones((3, 2)), {name: values[:3] for name, values in TWO.items()}, seed=0)
    with pytest.raises(UserError, match="1 of 4 settings lack some"):
        decompose(np.array([[1, 1], [1, np.nan], [1, 1], [1, 1]]), TWO, seed=0)
    with pytest.raises(UserError, match="a hyperparameter that varies"):
        decompose(np.ones((1, 2)), {"x": [1]}, seed=0)
    with pytest.raises(UserError, match="top: 0 is no share"):
        decompose(np.ones((4, 2)), TWO, top=0, seed=0)
    with pytest.raises(TooFewRunsError):
        decompose(np.ones((4, 1)), TWO, seed=0)
