"""Relations between hyperparameters as a grid writes them: `zip`, `derive` and `exclude` of an agent, read and checked.

What is wrong with single settings, such as a derived value out of its range, shows only when they are expanded
(`sweep.settings`).
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from typing import Any

from agents.hypers import Hyper
from sweep.arithmetic import Expression, ExpressionError, read_arithmetic, read_condition
from sweep.messages import suggestion


@dataclass(frozen=True)
class Relations:
    """How the hyperparameters of an agent depend on one another.

    `zipped` are groups of swept names that vary together, `derived` the hyperparameters that are computed from others, in an
    order in which they can be, `excluded` the conditions under which a setting is left out.
    """

    zipped: tuple[tuple[str, ...], ...] = ()
    derived: Mapping[str, Expression] = field(default_factory=dict)
    excluded: tuple[Expression, ...] = ()


@dataclass(frozen=True)
class Names:
    """What an agent's relations may refer to: the values of what it sweeps (none where they are wrong), what it fixes.

    `fixed` and `swept` say where in the file each name is. `table` holds the hyperparameters that the algorithm declares; a
    function declares none and takes any: it knows the names that it is given.
    """

    swept: Mapping[str, tuple[str, tuple[Any, ...]]]
    fixed: Mapping[str, str]
    table: Mapping[str, Hyper]

    def known(self, derived: Collection[str]) -> list[str]:
        """Return all names that have a value in every setting."""
        return list(dict.fromkeys([*self.table, *self.swept, *self.fixed, *derived]))


def read_relations(place: str, agent: Mapping[str, Any], names: Names) -> tuple[Relations, list[str]]:
    """Return the relations in one [[agent]], and a message for each mistake in them; `place` is `agent[2]`.

    Whatever has the wrong form is passed over: the form is checked elsewhere.
    """
    found: list[str] = []
    derive = agent.get("derive")
    derive = {key: text for key, text in derive.items() if isinstance(text, str)} if isinstance(derive, dict) else {}
    zipped = _zipped(f"{place}.zip", _list(agent.get("zip")), names, found)
    derived: dict[str, Expression] = {}
    for name, text in derive.items():
        found += _target_problems(f"{place}.derive.{name}", name, names)
        if expression := _read(f"{place}.derive.{name}", text, read_arithmetic, names.known(derive), found):
            derived[name] = expression
    try:
        derived = {name: derived[name] for name in _order(derived)}
    except ExpressionError as error:
        found.append(f"{place}.derive: {error}")
    excluded: dict[Expression, None] = {}
    for number, text in enumerate(_list(agent.get("exclude")), start=1):
        key = f"{place}.exclude[{number}]"
        if isinstance(text, str) and (condition := _read(key, text, read_condition, names.known(derive), found)):
            if condition in excluded:
                found.append(f'{key} = "{text}": listed twice')
            excluded[condition] = None
    return Relations(zipped, derived, tuple(excluded)), found


def zipped_names(groups: Any) -> set[str]:
    """Return the names that are in some group of a `zip`, as it was read."""
    return {name for group in _list(groups) for name in _list(group) if isinstance(name, str)}


def _zipped(place: str, groups: list[Any], names: Names, found: list[str]) -> tuple[tuple[str, ...], ...]:
    group_of: dict[str, int] = {}
    read = []
    for number, group in enumerate(groups, start=1):
        if not isinstance(group, list) or not all(isinstance(name, str) for name in group):
            continue
        if len(group) < 2:
            found.append(f"{place}[{number}]: a group has two names at least")
        for name in group:
            if name not in names.swept:
                found.append(f'{place}[{number}]: "{name}" is not swept by this agent; {suggestion(name, names.swept)}')
            if name in group_of:
                found.append(f'{place}[{number}]: "{name}" is in zip[{group_of[name]}] already')
            group_of[name] = number
        lengths = {name: len(names.swept[name][1]) for name in group if name in names.swept}
        if len(set(lengths.values())) > 1 and all(lengths.values()):
            shown = ", ".join(f"{name} has {length}" for name, length in lengths.items())
            found.append(f"{place}[{number}]: names that vary together need as many values each: {shown}")
        elif twice := _repeated([names.swept[name][1] for name in lengths]):
            found.append(f"{place}[{number}]: the values {', '.join(map(repr, twice))} are listed twice")
        read.append(tuple(group))
    return tuple(read)


def _repeated(columns: list[tuple[Any, ...]]) -> tuple[Any, ...] | None:
    times = Counter(zip(*columns, strict=False))
    return next((row for row, count in times.items() if count > 1), None)


def _target_problems(place: str, name: str, names: Names) -> list[str]:
    if name not in names.table:
        return [f"{place}: unknown hyperparameter; {suggestion(name, names.table)}"]
    if name in names.swept:
        return [f"{place}: is in {names.swept[name][0]} too; keep one"]
    return [f"{place}: is in {names.fixed[name]} too; keep one"] if name in names.fixed else []


def _read(
    place: str, text: str, read: Callable[[str], Expression], known: Collection[str], found: list[str]
) -> Expression | None:
    """Return the expression, or None and a message in `found`."""
    shown = text if len(text) <= 60 else text[:60] + "…"
    try:
        expression = read(text)
    except ExpressionError as error:
        found.append(f'{place} = "{shown}": {error}')
        return None
    unknown = [name for name in expression.names if name not in known]
    found += [f'{place} = "{shown}": unknown hyperparameter "{name}"; {suggestion(name, known)}' for name in unknown]
    return None if unknown else expression


def _order(derived: Mapping[str, Expression]) -> list[str]:
    """Return the derived names so that each comes after those that it refers to. Raises ExpressionError for a cycle."""
    graph = {name: [other for other in expression.names if other in derived] for name, expression in derived.items()}
    try:
        return list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        raise ExpressionError(f"goes in a circle: {' → '.join(reversed(error.args[1]))}") from None


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []
