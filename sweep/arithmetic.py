"""Arithmetic and conditions on hyperparameters, as grids write them: read with Python's grammar, never run as code.

An expression has + - * / **, parentheses, a minus sign, numbers and names; a condition compares expressions or texts, with and,
or, not. Whatever else the grammar knows is refused when the text is read, and so are long and deep ones: at most MAX_LENGTH
characters and MAX_DEPTH levels. Values are numbers of double precision; whole numbers stay whole where they are exact.
"""

import ast
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

MAX_LENGTH = 200
MAX_DEPTH = 20
_LARGEST_EXACT = 2**53

Number = int | float


class ExpressionError(ValueError):
    """A text is no expression, or has no value: the message says why, without naming the place."""


@dataclass(frozen=True)
class Expression:
    """An expression or a condition that was read: its text, and the names that it refers to, in order of appearance."""

    text: str
    names: tuple[str, ...]
    _tree: ast.expr = field(compare=False, repr=False)

    def value(self, values: Mapping[str, Any]) -> Number:
        """Return the number that the expression has with these values of its names. Raises ExpressionError."""
        return _number(self._tree, values)

    def holds(self, values: Mapping[str, Any]) -> bool:
        """Return whether the condition is true with these values of its names. Raises ExpressionError."""
        return _truth(self._tree, values)


def read_arithmetic(text: str) -> Expression:
    """Return the arithmetic that a text describes. Raises ExpressionError when it is anything else."""
    return _read(text, _check_number)


def read_condition(text: str) -> Expression:
    """Return the condition that a text describes. Raises ExpressionError when it is anything else."""
    return _read(text, _check_condition)


def _read(text: str, check: Callable[[ast.expr, int], None]) -> Expression:
    if len(text) > MAX_LENGTH:
        raise ExpressionError(f"is longer than {MAX_LENGTH} characters")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the grammar warns of texts that are refused below
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ExpressionError("cannot be read as an expression") from None
    check(tree, 1)
    names = [node.id for node in ast.walk(tree) if isinstance(node, ast.Name)]
    return Expression(text, tuple(dict.fromkeys(names)), tree)


def _check_depth(depth: int) -> None:
    if depth > MAX_DEPTH:
        raise ExpressionError(f"is nested deeper than {MAX_DEPTH} levels")


def _check_number(tree: ast.expr, depth: int) -> None:
    _check_depth(depth)
    match tree:
        case ast.BinOp(left, operator, right) if type(operator) in _OPERATORS:
            _check_number(left, depth + 1)
            _check_number(right, depth + 1)
        case ast.UnaryOp(ast.USub(), operand):
            _check_number(operand, depth + 1)
        case ast.Name():
            pass
        case ast.Constant(int() | float() as value) if not isinstance(value, bool):
            _bounded(value)
        case _:
            raise ExpressionError(f"{_shown(tree)} is not allowed: only + - * / ** ( ), numbers and names of hyperparameters")


def _check_condition(tree: ast.expr, depth: int) -> None:
    _check_depth(depth)
    match tree:
        case ast.BoolOp(_, parts):
            for part in parts:
                _check_condition(part, depth + 1)
        case ast.UnaryOp(ast.Not(), operand):
            _check_condition(operand, depth + 1)
        case ast.Compare(left, operators, others) if all(type(operator) in _COMPARISONS for operator in operators):
            for side in (left, *others):
                if not _is_text(side):
                    _check_number(side, depth + 1)
        case _:
            raise ExpressionError(f"{_shown(tree)} is no comparison: only == != < <= > >= between values, with and, or, not")


def _is_text(tree: ast.expr) -> bool:
    return isinstance(tree, ast.Constant) and isinstance(tree.value, str)


def _shown(tree: ast.expr) -> str:
    try:
        return ast.unparse(tree)
    except (RecursionError, ValueError):
        return "this"


def _number(tree: ast.expr, values: Mapping[str, Any]) -> Number:
    match tree:
        case ast.BinOp(left, operator, right):
            return _bounded(_OPERATORS[type(operator)](_number(left, values), _number(right, values)))
        case ast.UnaryOp(_, operand):
            return -_number(operand, values)
        case ast.Name(name):
            value = values[name]
            if not isinstance(value, int | float):
                raise ExpressionError(f"{name} is {_kind(value)}, no number")
            return _bounded(value)
        case ast.Constant(int() | float() as value):
            return _bounded(value)
    raise ExpressionError("is no arithmetic")


def _bounded(value: Number) -> Number:
    """Return a number that a double can hold. A whole number above 2^53 becomes one: sums and products stay small."""
    try:
        number = float(value)
    except OverflowError:
        raise ExpressionError("is too large") from None
    if not math.isfinite(number):
        raise ExpressionError("is too large")
    return int(value) if isinstance(value, int) and abs(value) <= _LARGEST_EXACT else number


def _divide(dividend: Number, divisor: Number) -> Number:
    if divisor == 0:
        raise ExpressionError("divides by zero")
    return dividend / divisor


def _raise_to(base: Number, exponent: Number) -> Number:
    if base == 0 and exponent < 0:
        raise ExpressionError("divides by zero")
    try:
        power = math.pow(base, exponent)
    except OverflowError:
        raise ExpressionError("is too large") from None
    except ValueError:
        raise ExpressionError("is no real number: a root of a negative number") from None
    whole = isinstance(base, int) and isinstance(exponent, int) and exponent >= 0 and abs(power) <= _LARGEST_EXACT
    return int(power) if whole else power


_OPERATORS: dict[type[ast.operator], Callable[[Number, Number], Number]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: _divide,
    ast.Pow: _raise_to,
}


def _truth(tree: ast.expr, values: Mapping[str, Any]) -> bool:
    match tree:
        case ast.BoolOp(operator, parts):
            combine = all if isinstance(operator, ast.And) else any
            return combine(_truth(part, values) for part in parts)
        case ast.UnaryOp(_, operand):
            return not _truth(operand, values)
        case ast.Compare(left, operators, others):
            sides = [_side(side, values) for side in (left, *others)]
            return all(_compare(operator, a, b) for operator, a, b in zip(operators, sides[:-1], sides[1:], strict=True))
    raise ExpressionError("is no condition")


def _side(tree: ast.expr, values: Mapping[str, Any]) -> Number | str:
    if isinstance(tree, ast.Constant) and isinstance(tree.value, str):
        return tree.value
    if isinstance(tree, ast.Name) and isinstance(text := values[tree.id], str):
        return text
    return _number(tree, values)


def _compare(operator: ast.cmpop, a: Number | str, b: Number | str) -> bool:
    if isinstance(a, str) != isinstance(b, str):
        raise ExpressionError(f"compares {_kind(a)} with {_kind(b)}")
    if isinstance(a, str) and not isinstance(operator, ast.Eq | ast.NotEq):
        raise ExpressionError("orders texts: they can be compared with == and != only")
    return _COMPARISONS[type(operator)](a, b)


_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: lambda a, b: a == b,
    ast.NotEq: lambda a, b: a != b,
    ast.Lt: lambda a, b: a < b,
    ast.LtE: lambda a, b: a <= b,
    ast.Gt: lambda a, b: a > b,
    ast.GtE: lambda a, b: a >= b,
}


def _kind(value: Any) -> str:
    return "a list" if isinstance(value, list | tuple) else "a text" if isinstance(value, str) else "a number"
