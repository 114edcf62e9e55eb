"""Sensitivity and effective dimensionality, against tables by hand and enumeration of subsets."""

import itertools

import numpy as np
import pytest

from analysis.statistics.estimate import TooFewRunsError
from analysis.statistics.hyperparameter_sensitivity import effective_dimensionality, evaluated, plane_region, sensitivity
from sweep.messages import UserError

# Two environments, three settings: the best are 1.0 and 0.9; the settings' means are 0.6, 0.6 and 0.5
TABLE = np.array([[1.0, 0.6, 0.1], [0.2, 0.6, 0.9]])


def exact(table: np.ndarray, luck: float = 0.0) -> np.ndarray:
    """Return two seeds, with ± luck that all settings and environments share."""
    return table[..., None] + luck * np.array([1, -1])


def test_sensitivity_is_what_tuning_to_each_environment_gains():
    found = sensitivity(exact(TABLE), resamples=100, seed=0)
    assert (found.tuned.value, found.compromise.value, found.sensitivity.value) == pytest.approx((0.95, 0.6, 0.35))
    assert (found.best_per_environment, found.best_across) == ((0, 2), 0)  # of the equal 0.6 the first
    assert (found.sensitivity.num_runs, found.sensitivity.resamples, found.num_settings) == (2, 100, 3)


def test_shared_luck_moves_the_scores_and_not_the_sensitivity():
    found = sensitivity(exact(TABLE, 0.1), resamples=400, seed=0)
    assert (found.sensitivity.low, found.sensitivity.high) == pytest.approx((0.35, 0.35))
    assert (found.tuned.low, found.tuned.high) == pytest.approx((0.85, 1.05))
    alone = sensitivity(exact(TABLE, 0.1), paired=False, resamples=400, seed=0)
    assert alone.sensitivity.low < 0.35 < alone.sensitivity.high


def test_one_setting_that_is_best_everywhere_has_no_sensitivity():
    assert sensitivity(exact(np.array([[1.0, 0.5], [2.0, 0.1]])), seed=0, resamples=10).sensitivity.value == 0


def test_noise_alone_makes_a_sensitivity_that_fresh_seeds_do_not_have():
    generator = np.random.default_rng(0)
    seen, fresh = [], []
    for seed in range(60):
        found = sensitivity(generator.normal(size=(4, 10, 5)), resamples=2, seed=seed)
        seen.append(found.sensitivity.value)
        again = generator.normal(size=(4, 10, 5))
        tuned = np.stack([again[e, h] for e, h in enumerate(found.best_per_environment)])
        fresh.append(evaluated(tuned, again[:, found.best_across], resamples=2, seed=seed)[0].value)
    assert np.mean(seen) > 0.3
    assert np.mean(fresh) == pytest.approx(0, abs=4 * np.std(fresh) / np.sqrt(60))


def test_evaluated_scores_are_means_and_runs_in_common_add_nothing():
    runs = np.array([[1.0, 3, 8], [2, 2, 2]])
    phi, tuned, compromise = evaluated(runs, runs, seed=0)
    assert (phi.value, phi.low, phi.high) == (0, 0, 0)
    assert (tuned.value, compromise.value) == (3, 3)
    other = np.array([[0.0, 2, 7], [2, 2, 2]])
    phi, tuned, compromise = evaluated(runs, other, seed=0)
    assert (phi.value, phi.low, phi.high) == pytest.approx((0.5, 0.5, 0.5))
    assert (tuned.value, compromise.value) == pytest.approx((3, 2.5))
    assert tuned.low < 3 < tuned.high
    with pytest.raises(UserError, match="the same environments and seeds"):
        evaluated(runs, other[:1], seed=0)


@pytest.mark.parametrize(
    ("point", "region"),
    [
        ((0.1, 0.6), "better either way"),
        ((0.2, 0.5), "better either way"),  # the reference itself
        ((0.3, 0.7), "better either way"),  # dearer to tune by less than it gains
        ((0.4, 0.6), "better only tuned to each environment"),
        ((0.0, 0.4), "better only with one setting for all"),
        ((0.1, 0.3), "worse either way"),
        ((0.3, 0.4), "worse either way"),
    ],
)
def test_regions_of_the_plane_are_split_by_two_lines(point, region):
    assert plane_region(*point, 0.2, 0.5) == region


def test_one_hyperparameter_that_needs_tuning_is_one_dimension():
    hypers = {"x": [0, 0, 1, 1], "y": [0, 1, 0, 1]}
    # x = 0 is best in the first environment, x = 1 in the second; y makes 1 % of a difference
    scores = exact(np.array([[1.0, 0.99, 0.5, 0.49], [0.3, 0.3, 0.99, 1.0]]))
    found = effective_dimensionality(scores, hypers, normalizer="minmax", seed=0)
    # the compromise is (1, 0): 0.745, as (1, 1) is, and the first; with x free 0.995; with y free 0.75; with both 1
    assert found.defaults == 2
    assert found.subset_scores == pytest.approx({(): 0.745, ("x",): 0.995, ("y",): 0.75, ("x", "y"): 1.0})
    assert found.dimensionality == 1
    assert found.interpolated == pytest.approx((0.95 - 0.745) / (0.995 - 0.745))
    assert found.best_subsets == ((), ("x",), ("x", "y"))
    assert found.best_scores == pytest.approx([0.745, 0.995, 1.0])
    assert found.probabilities.tolist() == [0, 1, 0]


def test_a_setting_that_is_good_everywhere_has_no_dimension():
    scores = exact(np.array([[1.0, 0.5, 0.2, 0.1]] * 3))
    found = effective_dimensionality(scores, {"x": [0, 0, 1, 1], "y": [0, 1, 0, 1]}, normalizer="cdf", seed=0)
    assert (found.dimensionality, found.interpolated) == (0, 0)


def test_two_of_three_hyperparameters_may_be_needed():
    cells = list(itertools.product([0, 1], repeat=3))
    hypers = {name: [cell[axis] for cell in cells] for axis, name in enumerate("xyz")}
    # each environment wants its own (x, y), and half of it is worth half
    wanted = [(0, 0), (0, 1), (1, 0), (1, 1)]
    table = np.array([[((x == a) + (y == b)) / 2 for x, y, _ in cells] for a, b in wanted])
    found = effective_dimensionality(exact(table), hypers, normalizer="minmax", seed=0)
    assert found.best_scores == pytest.approx([0.5, 0.75, 1, 1])
    assert (found.dimensionality, found.best_subsets[2]) == (2, ("x", "y"))
    assert found.interpolated == pytest.approx(1.8)


def test_subset_scores_are_those_of_settings_that_agree_with_the_compromise_elsewhere():
    generator = np.random.default_rng(0)
    cells = [cell for cell in itertools.product(range(2), range(3), range(2), range(2)) if sum(cell) != 3]  # not a full grid
    hypers = {name: [cell[axis] for cell in cells] for axis, name in enumerate("abcd")}
    scores = generator.uniform(size=(3, len(cells), 4))
    found = effective_dimensionality(scores, hypers, normalizer="percentile", seed=0)
    means = scores.mean(axis=2)
    default = cells[int(means.mean(axis=0).argmax())]
    for free in itertools.chain.from_iterable(itertools.combinations("abcd", m) for m in range(5)):
        agree = [
            h
            for h, cell in enumerate(cells)
            if all(cell["abcd".index(name)] == default["abcd".index(name)] for name in "abcd" if name not in free)
        ]
        assert found.subset_scores[free] == pytest.approx(means[:, agree].max(axis=1).mean())
    assert found.probabilities.sum() == pytest.approx(1)
    assert (found.probabilities > 0).sum() > 1


def test_hyperparameters_that_vary_together_are_one():
    hypers = {"n": [10, 20, 10, 20], "rho": [0.3, 0.15, 0.3, 0.15], "x": [0, 0, 1, 1]}
    found = effective_dimensionality(exact(np.ones((2, 4))), hypers, normalizer="minmax", seed=0)
    assert len(found.best_scores) == 3
    assert ("n & rho",) in found.subset_scores


def test_bad_requests_are_refused():
    hypers = {"x": [0, 1, 2]}
    with pytest.raises(UserError, match='means nothing with normalizer "thesis"'):
        effective_dimensionality(exact(TABLE), hypers, normalizer="thesis", seed=0)
    with pytest.raises(UserError, match=r"tuned score, which is not positive: -0\.05"):
        effective_dimensionality(exact(TABLE - 1), hypers, normalizer="minmax", seed=0)
    cells = np.eye(14, dtype=int)
    with pytest.raises(UserError, match="at most 12 hyperparameters, not 13"):
        effective_dimensionality(
            np.ones((1, 14, 2)), {f"h{i}": cells[:, i].tolist() for i in range(13)}, normalizer="minmax", seed=0
        )
    with pytest.raises(UserError, match="1 of 6 settings lack some"):
        sensitivity(np.where(np.arange(12).reshape(2, 3, 2) == 5, np.nan, 1.0), seed=0)
    with pytest.raises(TooFewRunsError):
        sensitivity(TABLE[..., None], seed=0)
