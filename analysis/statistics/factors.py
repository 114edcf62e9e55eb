"""Factors: the hyperparameters of a grid as axes of an array, those that always vary together as one axis.

A list of settings is described by name → the value of each setting. Two hyperparameters of which each determines the other
(derived ones, say) cannot be told apart by any statistic: they are one factor. So are those that the caller names, such as a
`zip` of the grid.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.messages import UserError, suggestion

_NAMED = 5  # missing cells that a message names


@dataclass(frozen=True)
class Factors:
    """Axes of a grid. `names`: the hyperparameters of each axis; `levels`: its values, a tuple of one value a name.

    `positions` [H, axes]: the level of each setting on each axis.
    """

    names: tuple[tuple[str, ...], ...]
    levels: tuple[tuple[tuple[Any, ...], ...], ...]
    positions: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of levels of each axis."""
        return tuple(map(len, self.levels))

    @property
    def labels(self) -> tuple[str, ...]:
        """A text for each axis: the names of its hyperparameters, joined by " & "."""
        return tuple(map(" & ".join, self.names))

    def describe(self, cell: Sequence[int]) -> str:
        """Return a cell in words: `critic_step_size = 0.1, entropy_scale = 10`."""
        parts = [
            f"{name} = {value}"
            for names, levels, position in zip(self.names, self.levels, cell, strict=True)
            for name, value in zip(names, levels[position], strict=True)
        ]
        return ", ".join(parts)


def find_factors(
    hypers: Mapping[str, Sequence[Any]],
    together: Iterable[Sequence[str]] = (),
    planned: Mapping[str, Sequence[Any]] | None = None,
) -> Factors:
    """Return the axes of settings, in the order of `hypers`; hyperparameters with one value are left out.

    `together`: groups of names that are one axis each. `planned`: the values of all settings of the grid where `hypers` are
    those of a part of it, in which hyperparameters may happen to vary together that do not in the grid. Raises UserError for an
    unknown name there, or one that is in two groups.
    """
    groups = [list(group) for group in together]
    _check(hypers, [name for group in groups for name in group])
    varying = {name: [_plain(value) for value in values] for name, values in hypers.items()}
    varying = {name: values for name, values in varying.items() if len(levels(values)) > 1}
    grid = {name: [_plain(value) for value in (planned or hypers)[name]] for name in varying}
    axes: list[list[str]] = []
    for name in varying:
        group = next((group for group in groups if name in group), None)
        if group is not None:
            own = [axis for axis in axes if axis[0] in group]
        else:
            own = [axis for axis in axes if _are_one(grid[axis[0]], grid[name])]
        if own:
            own[0].append(name)
        else:
            axes.append([name])
    columns = [list(zip(*(varying[name] for name in axis), strict=True)) for axis in axes]
    known = [levels(column) for column in columns]
    positions = [[ranks.index(value) for value in column] for ranks, column in zip(known, columns, strict=True)]
    length = len(next(iter(hypers.values()), ()))
    return Factors(
        names=tuple(map(tuple, axes)),
        levels=tuple(map(tuple, known)),
        positions=np.array(positions, int).reshape(len(axes), length).T,
    )


def on_full_grid(scores: np.ndarray, factors: Factors, what: str) -> np.ndarray:
    """Return scores [H, S] as [levels of axis 0, levels of axis 1, …, S].

    Raises UserError unless each combination of levels is one setting, naming those that none is.
    """
    shape = factors.shape
    cells = [tuple(row) for row in factors.positions.tolist()]
    if len(set(cells)) < len(cells):
        twice = next(cell for cell in cells if cells.count(cell) > 1)
        raise UserError(
            f"{what} needs one setting a combination, and several have {factors.describe(twice) or 'the same values'}"
        )
    missing = sorted(set(itertools.product(*map(range, shape))) - set(cells)) if len(cells) < np.prod(shape) else []
    if missing:
        named = "; ".join(map(factors.describe, missing[:_NAMED])) + ("; …" if len(missing) > _NAMED else "")
        raise UserError(
            f"{what} needs a full grid, and {len(missing):,} of {np.prod(shape):,} combinations of {', '.join(factors.labels)} "
            f"are no settings: {named}. Name hyperparameters that vary together as one, or take a part of the grid"
        )
    grid = np.empty((*shape, scores.shape[-1]))
    grid[tuple(factors.positions.T)] = scores
    return grid


def determines(values: Sequence[Any], others: Sequence[Any]) -> bool:
    """Return whether settings with equal `values` have equal `others`."""
    return len(set(zip(values, others, strict=True))) == len(set(values))


def _are_one(values: Sequence[Any], others: Sequence[Any]) -> bool:
    return determines(values, others) and determines(others, values)


def levels(values: Iterable[Any]) -> list[Any]:
    """Return the distinct values: numbers ascending, then texts, then None."""
    return sorted(set(map(_plain, values)), key=_order)


def _order(value: Any) -> tuple[Any, ...]:
    if isinstance(value, tuple):
        return (1, tuple(map(_order, value)))
    number = isinstance(value, int | float)
    return (0, 0, value, "") if number else (0, 1 if value is not None else 2, 0, str(value))


def _plain(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _check(hypers: Mapping[str, Sequence[Any]], named: Sequence[str]) -> None:
    for name in named:
        if name not in hypers:
            raise UserError(f'"{name}" is no hyperparameter of these settings; {suggestion(name, hypers)}')
        if named.count(name) > 1:
            raise UserError(f'"{name}" is in two groups of hyperparameters that vary together')
