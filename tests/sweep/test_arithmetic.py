import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sweep.arithmetic import MAX_LENGTH, ExpressionError, read_arithmetic, read_condition

VALUES = {"a": 3, "b": 0.5, "c": -2.0, "n": 30, "name": "mean"}
STRENGTH = {"+": 1, "-": 1, "*": 2, "/": 2, "**": 4}


class UndefinedError(Exception):
    """The expression has no value."""


def apply(operator, a, b):
    """The oracle: floating-point numbers only, worked out while the text is made."""
    try:
        result = {
            "+": lambda: a + b,
            "-": lambda: a - b,
            "*": lambda: a * b,
            "/": lambda: a / b,
            "**": lambda: math.pow(a, b),
        }[operator]()
    except (ZeroDivisionError, OverflowError, ValueError):
        raise UndefinedError from None
    if not math.isfinite(result):
        raise UndefinedError
    return result


@st.composite
def expressions(draw, depth=0):
    """A text with as few parentheses as the usual rules allow, its value (None: it has none), how strongly it binds."""
    kind = (
        draw(st.sampled_from(["number", "name", "binary", "minus"])) if depth < 5 else draw(st.sampled_from(["number", "name"]))
    )
    if kind == "number":
        number = draw(st.one_of(st.integers(0, 100), st.sampled_from([0.25, 1e-5, 3.5, 1e10])))
        return repr(number), float(number), 9
    if kind == "name":
        name = draw(st.sampled_from(["a", "b", "c", "n"]))
        return name, float(VALUES[name]), 9
    left, a, left_strength = draw(expressions(depth=depth + 1))
    if kind == "minus":  # weaker than a power, stronger than a product
        return (f"-{left}" if left_strength >= 3 else f"-({left})"), None if a is None else -a, 3
    operator = draw(st.sampled_from(sorted(STRENGTH)))
    strength = STRENGTH[operator]
    right, b, right_strength = draw(expressions(depth=depth + 1))
    if operator == "**":  # from the right, and a minus may follow it
        left = left if left_strength > strength else f"({left})"
        right = right if right_strength >= 3 else f"({right})"
    else:
        left = left if left_strength >= strength else f"({left})"
        right = right if right_strength > strength else f"({right})"
    try:
        value = None if a is None or b is None else apply(operator, a, b)
    except UndefinedError:
        value = None
    return f"{left} {operator} {right}", value, strength


@settings(max_examples=400, deadline=None)
@given(expressions())
def test_an_expression_has_the_value_that_was_worked_out_while_it_was_written(made):
    text, expected, _ = made
    if len(text) > MAX_LENGTH:
        return
    expression = read_arithmetic(text)
    if expected is None:
        with pytest.raises(ExpressionError):
            expression.value(VALUES)
    else:
        assert expression.value(VALUES) == expected


ANYTHING = st.one_of(
    st.text(max_size=250),
    st.text("0123456789.e_+-*/%()[]{}<>=!&|^~@:,;'\"\\ \n\tabcn#jx", max_size=80),
    st.lists(
        st.sampled_from(
            [*"abcn+-*/()<>=! ", "**", "//", "==", " and ", " or ", "not ", " in ", " is ", " if ", " else ", "lambda"]
        ),
        max_size=40,
    ).map("".join),
)


@settings(max_examples=500, deadline=None)
@given(ANYTHING)
@example("9**9**9**9")
@example("(" * 200)
@example("-" * 199 + "1")
@example("1 if a else b")
@example("\0")
@example("a.b")
@example("'\\d' == a")
@example("1is 2")
@example("\ud800")
@example("f'{a}'")
@example("0x" + "F" * 190)
def test_no_text_makes_it_raise_anything_but_its_own_error(text):
    for read in (read_arithmetic, read_condition):
        try:
            expression = read(text)
            if set(expression.names) <= VALUES.keys():
                found = expression.value(VALUES) if read is read_arithmetic else expression.holds(VALUES)
                assert type(found) in ((int, float) if read is read_arithmetic else (bool,))
                assert math.isfinite(found)
        except ExpressionError:
            pass


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3 / n", 0.1),
        ("-2 ** 2", -4),
        ("2 ** 3 ** 2", 512),
        ("2 ** -1", 0.5),
        ("8 / 4 / 2", 1.0),
        ("7 - 4 - 2", 1),
        ("2 + 3 * 4", 14),
        ("(2 + 3) * 4", 20),
        (" a ", 3),
        ("1_000", 1000),
    ],
)
def test_precedence_is_that_of_mathematics(text, value):
    found = read_arithmetic(text).value(VALUES)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize("text", ["2 ** 53 + 1", "2 ** 53 * 3", "3 ** 40"])
def test_whole_numbers_that_a_double_does_not_hold_become_doubles(text):
    assert type(read_arithmetic(text).value({})) is float


def test_whole_numbers_stay_whole_up_to_two_to_the_53():
    assert repr(read_arithmetic("2 ** 52 + 2 ** 52 - 1").value({})) == "9007199254740991"


@pytest.mark.parametrize("text", ["9**9**9", "9**9**9**9", "10.0 ** 308 * 10", "-(10 ** 308) * 10", "1e999"])
def test_what_no_double_holds_is_too_large(text):
    with pytest.raises(ExpressionError, match=r"^is too large$"):
        read_arithmetic(text).value({})


@pytest.mark.parametrize("text", ["1 / 0", "1 / (3 - a)", "0 ** -1", "1 / 0.0"])
def test_division_by_zero_has_no_value(text):
    with pytest.raises(ExpressionError, match=r"^divides by zero$"):
        read_arithmetic(text).value(VALUES)


def test_depth_and_length_are_bounded_where_they_are_said_to_be():
    assert read_arithmetic("-" * 19 + "1").value({}) == -1
    with pytest.raises(ExpressionError, match=r"^is nested deeper than 20 levels$"):
        read_arithmetic("-" * 20 + "1")
    assert read_arithmetic("1" + " " * 199).value({}) == 1
    with pytest.raises(ExpressionError, match=r"^is longer than 200 characters$"):
        read_arithmetic("1" + " " * 200)


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("a == 3", True),
        ("a == 3.0", True),
        ("a != 3", False),
        ("b < 0.5", False),
        ("b <= 0.5", True),
        ("c > -2", False),
        ("c >= -2", True),
        ("1 < a < 5", True),
        ("1 < a < 2", False),
        ("a == 3 and b == 1", False),
        ("a == 4 or b == 0.5", True),
        ("not a == 3", False),
        ("not (a == 4 or b == 1) and n == 30", True),
        ("a * 10 == n", True),
        ("name == 'mean'", True),
        ('name != "mean"', False),
        ("'mean' == name", True),
        ("a == 3 or 1 / 0 == 1", True),
        ("a == 1or b == 0.5", True),  # of which the grammar warns
    ],
)
def test_conditions_hold_as_they_read(text, holds):
    assert read_condition(text).holds(VALUES) is holds


def test_the_names_of_an_expression_are_those_it_refers_to():
    assert read_condition("b < a and name == 'a' or c * b > 2").names == ("b", "a", "name", "c")
