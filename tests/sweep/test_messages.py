"""Words for people."""

import traceback

import pytest

from sweep.messages import counted, duration, gist


def raised(error):
    try:
        raise error
    except Exception as caught:
        return "".join(traceback.format_exception(caught))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (raised(ValueError("one line")), "ValueError: one line"),
        (raised(ValueError("first\nsecond\n  third")), "ValueError: first"),
        (raised(KeyError("name")), "KeyError: 'name'"),
        ("The worker died.\nKilled", "Killed"),
        ("  File without an error", "File without an error"),
        ("", ""),
    ],
)
def test_the_gist_of_a_traceback_is_the_type_and_the_first_line_of_the_message(text, expected):
    assert gist(text) == expected


def test_the_gist_of_an_error_that_another_one_caused_is_the_last_ones():
    try:
        try:
            raise KeyError("inner")
        except KeyError as error:
            raise RuntimeError("outer\nmore") from error
    except RuntimeError as error:
        text = "".join(traceback.format_exception(error))
    assert gist(text) == "RuntimeError: outer"


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [(None, "…"), (0.2, "0 s"), (59.6, "1 min 00 s"), (61, "1 min 01 s"), (7_500, "2 h 05 min"), (360_000, "100 h 00 min")],
)
def test_times_are_told_in_two_units_at_most(seconds, expected):
    assert duration(seconds) == expected


def test_one_is_singular():
    assert [counted(number, "trial") for number in (0, 1, 2_000)] == ["0 trials", "1 trial", "2,000 trials"]
