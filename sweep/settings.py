"""Settings of an agent: the values of a sweep, and the hyperparameters that follow from them by product, zip, derive, exclude.

A setting is checked before it is dropped for nothing: hyperparameters are derived and checked only where no condition on the
others excludes it.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from agents.hypers import FreeHypers, Hyper, HyperparameterError, Hypers
from sweep.arithmetic import Expression, ExpressionError
from sweep.relations import Relations

_LONGEST = 80
_MOST_PROBLEMS = 10
_FORMS = "a list, { values = […] }, { logspace = [first exponent, last exponent, count] } or { range = [first, last, step] }"


def swept_values(hyper: Hyper, sweep: Any, repeats: bool = False) -> tuple[Any, ...]:
    """Return the values of a sweep in canonical types. Raises HyperparameterError when there are none, or one is bad.

    With `repeats` a value may come again: where it varies together with others.
    """
    if isinstance(sweep, dict):
        form, listed = next(iter(sweep.items())) if len(sweep) == 1 else ("", None)
        if form not in ("values", "logspace", "range") or not isinstance(listed, list):
            raise HyperparameterError(f"must be {_FORMS}")
        values = listed if form == "values" else _series(form, listed)
    elif isinstance(sweep, list):
        values = sweep
    else:
        raise HyperparameterError(f"must be {_FORMS}; a single value belongs in [fixed]")
    if not values:
        raise HyperparameterError("nothing to sweep: the list of values is empty")
    checked: list[Any] = []
    seen: set[Any] = set()
    for value in values:
        try:
            checked.append(hyper.check(value))
        except HyperparameterError as error:
            raise HyperparameterError(f"value {shown(value)} {error}") from None
        if not repeats and checked[-1] in seen:
            raise HyperparameterError(f"value {shown(value)} is listed twice")
        seen.add(checked[-1])
    return tuple(checked)


def shown(value: Any) -> str:
    """Return a value as messages write it, not longer than a line."""
    try:
        text = repr(value)
    except ValueError:  # Python writes no number of more than 4,300 digits
        text = "a number of thousands of digits"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def _series(form: str, arguments: list[Any]) -> list[float | int]:
    if len(arguments) != 3 or not all(type(x) in (int, float) and abs(x) < 1e300 for x in arguments):
        raise HyperparameterError(f"{form} takes three numbers: {_FORMS}")
    first, last, third = arguments
    if form == "logspace":
        if type(third) is not int or not 2 <= third <= 10_000 or max(abs(first), abs(last)) > 300:
            raise HyperparameterError(
                "logspace = [first exponent, last exponent, count] needs a count of 2 to 10,000 and exponents within ±300"
            )
        return [float(f"{10 ** (first + (last - first) * i / (third - 1)):.12g}") for i in range(third)]
    if third == 0 or (last - first) / third < 0 or (last - first) / third > 10_000:
        raise HyperparameterError(
            "range = [first, last, step] needs a step that leads from first to last in at most 10,000 values"
        )
    count = math.floor((last - first) / third + 1e-9) + 1
    values = [first + i * third for i in range(count)]
    return [value if type(value) is int else float(f"{value:.12g}") for value in values]


def count(values: Mapping[str, Sequence[Any]], zipped: Sequence[Sequence[str]]) -> int:
    """Return how many settings there are at most: before any is excluded, or becomes equal to another."""
    return math.prod(len(values[names[0]]) for names in _axes(values, zipped))


def expand_settings(
    hypers: type[Hypers], values: Mapping[str, Sequence[Any]], relations: Relations, place: str
) -> tuple[tuple[Hypers, ...], list[str]]:
    """Return the settings of an agent, the last name varying fastest, and a message for each thing that is wrong with them.

    `place` is what messages call the agent: `agent[2]`.
    """
    defaults = {} if issubclass(hypers, FreeHypers) else hypers().as_dict()
    conditions = {f"{place}.exclude[{i}]": condition for i, condition in enumerate(relations.excluded, start=1)}
    late = {key: condition for key, condition in conditions.items() if relations.derived.keys() & set(condition.names)}
    early = {key: condition for key, condition in conditions.items() if key not in late}
    problems: dict[str, None] = {}
    useful: set[str] = set()
    settings: list[Hypers] = []
    for chosen in _product(values, relations.zipped):
        scope = defaults | chosen
        try:
            if _excluded(early, scope, useful):
                continue
            derived = _derive(hypers, relations.derived, scope, place)
            if not _excluded(late, scope | derived, useful):
                settings.append(hypers(**chosen, **derived))
        except ExpressionError as error:
            problems[str(error)] = None
        except HyperparameterError as error:
            problems[f"{place}: {error}"] = None
    if not problems:
        for key, condition in conditions.items():
            if key not in useful:
                problems[f'{key} = "{condition.text}": excludes no setting'] = None
        if not settings:
            problems[f"{place}.exclude: excludes every setting"] = None
    more = len(problems) - _MOST_PROBLEMS
    return tuple(settings), [
        *list(problems)[:_MOST_PROBLEMS],
        *([f"{place}: and {more:,} more of this kind"] if more > 0 else []),
    ]


def _axes(values: Mapping[str, Any], zipped: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """Return the names that vary together, each group where its first name is."""
    group_of = {name: tuple(group) for group in zipped for name in group}
    return list(dict.fromkeys(group_of.get(name, (name,)) for name in values))


def _product(values: Mapping[str, Sequence[Any]], zipped: Sequence[Sequence[str]]) -> Iterator[dict[str, Any]]:
    axes = _axes(values, zipped)
    together = [list(zip(*(values[name] for name in names), strict=True)) for names in axes]
    names = list(itertools.chain.from_iterable(axes))
    for choice in itertools.product(*together):
        yield dict(zip(names, itertools.chain.from_iterable(choice), strict=True))


def _excluded(conditions: Mapping[str, Expression], scope: Mapping[str, Any], useful: set[str]) -> bool:
    """Return whether a condition holds, and add those that do to `useful`: each should exclude something by itself."""
    held = []
    for key, condition in conditions.items():
        try:
            if condition.holds(scope):
                held.append(key)
        except ExpressionError as error:
            raise ExpressionError(f'{key} = "{condition.text}": {error}{_where(condition, scope)}') from None
    useful.update(held)
    return bool(held)


def _derive(hypers: type[Hypers], derived: Mapping[str, Expression], scope: Mapping[str, Any], place: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, expression in derived.items():
        known = {**scope, **found}
        try:
            value = expression.value(known)
            found[name] = hypers.table[name].check(value)
        except ExpressionError as error:
            problem = str(error)
        except HyperparameterError as error:
            problem = f"gives {value!r}, which {error}"
        else:
            continue
        raise ExpressionError(f'{place}.derive.{name} = "{expression.text}": {problem}{_where(expression, known)}')
    return found


def _where(expression: Expression, scope: Mapping[str, Any]) -> str:
    values = [f"{name} = {list(value) if isinstance(value := scope[name], tuple) else value!r}" for name in expression.names]
    return f" where {', '.join(values)}" if values else ""
