"""Factors: which hyperparameters are axes of a grid, and whether the grid is full."""

import numpy as np
import pytest

from analysis.statistics.factors import determines, find_factors, levels, on_full_grid
from sweep.messages import UserError

GRID = {"x": [0.1, 0.1, 1.0, 1.0], "y": ["b", "a", "b", "a"]}


def test_axes_are_hyperparameters_that_vary_and_levels_are_in_order():
    factors = find_factors({**GRID, "z": [3, 3, 3, 3]})
    assert factors.names == (("x",), ("y",))
    assert factors.levels == (((0.1,), (1.0,)), (("a",), ("b",)))
    assert factors.positions.tolist() == [[0, 1], [0, 0], [1, 1], [1, 0]]


def test_numbers_come_before_texts_and_none_comes_last():
    assert levels(["b", None, 10, 9.5, (64, 64), "a"]) == [9.5, 10, "a", "b", None, (64, 64)]


def test_a_derived_hyperparameter_is_one_axis_with_its_own():
    factors = find_factors({"n": [10, 20, 30, 10, 20, 30], "rho": [0.3, 0.15, 0.1] * 2, "x": [1, 1, 1, 2, 2, 2]})
    assert factors.labels == ("n & rho", "x")
    assert factors.shape == (3, 2)


def test_one_that_only_follows_from_another_is_an_axis_of_its_own():
    assert find_factors({"x": [1, 2, 3], "y": [1, 1, 2]}).labels == ("x", "y")
    assert find_factors({"y": [1, 1, 2], "x": [1, 2, 3]}).labels == ("y", "x")


def test_those_named_together_are_one_axis_whatever_their_values():
    hypers = {"x": [1, 2, 2], "kappa": [1, 1, 2]}
    assert find_factors(hypers).labels == ("x", "kappa")
    factors = find_factors(hypers, [("kappa", "x")])
    assert factors.labels == ("x & kappa",)
    assert factors.levels == (((1, 1), (2, 1), (2, 2)),)


def test_a_name_that_is_unknown_or_named_twice_is_refused():
    with pytest.raises(UserError, match='did you mean "kappa"'):
        find_factors({"kappa": [1, 2], "x": [1, 2]}, [("kapa", "x")])
    with pytest.raises(UserError, match="two groups"):
        find_factors(GRID, [("x",), ("x", "y")])


def test_scores_are_put_where_their_levels_are():
    grid = on_full_grid(np.array([[1.0], [2], [3], [4]]), find_factors(GRID), "a test")
    assert grid[..., 0].tolist() == [[2, 1], [4, 3]]


def test_missing_combinations_are_named():
    part = {name: values[:3] for name, values in GRID.items()}
    with pytest.raises(UserError, match=r"1 of 4 combinations of x, y are no settings: x = 1.0, y = a\."):
        on_full_grid(np.ones((3, 1)), find_factors(part), "a test")


def test_two_settings_at_one_place_are_refused():
    with pytest.raises(UserError, match=r"several have x = 1, y = 1"):
        on_full_grid(np.ones((3, 1)), find_factors({"x": [1, 1, 2], "y": [1, 1, 2]}, []), "a test")


def test_a_value_determines_another_when_it_never_has_two():
    assert determines([1, 2, 3], ["a", "a", "b"])
    assert not determines(["a", "a", "b"], [1, 2, 3])


def test_what_varies_together_in_a_part_only_are_two_factors():
    planned = {"x": [1, 1, 2, 2], "y": [1, 2, 1, 2]}
    part = {"x": [1, 2], "y": [1, 2]}
    assert find_factors(part).labels == ("x & y",)
    assert find_factors(part, planned=planned).labels == ("x", "y")
