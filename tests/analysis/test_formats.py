"""Results as text and bytes."""

import csv
import io
import json
from datetime import UTC, datetime
from decimal import Decimal

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from analysis.formats import FORMATS, MOST_ROWS, format_result

TABLE = pa.table(
    {
        "name": ["alpha", "b|c", None],
        "mean": [1.5, float("nan"), -1234567.891],
        "seeds": pa.array([3, None, 10], pa.int64()),
        "widths": [[64, 64], [], None],
        "line": [{"setting": "a", "mean": float("inf")}, None, None],
    }
)


def test_a_table_is_aligned_with_numbers_to_the_right():
    assert format_result(TABLE.select(["name", "mean", "seeds"]), "table").decode().splitlines() == [
        "name           mean  seeds",
        "─────  ────────────  ─────",
        "alpha           1.5      3",
        "b|c             nan   NULL",
        "NULL   -1.23457e+06     10",
        "(3 rows)",
    ]


def test_a_table_of_no_rows_has_its_header():
    assert format_result(TABLE.slice(0, 0).select(["name"]), "table").decode() == "name\n────\n(0 rows)\n"


def test_a_long_table_says_how_much_of_it_is_shown():
    lines = format_result(pa.table({"n": range(MOST_ROWS + 1)}), "table").decode().splitlines()
    assert len(lines) == MOST_ROWS + 3
    assert lines[-1] == "(1,000 of 1,001 rows)"


def test_a_cell_of_several_lines_keeps_them():
    shown = format_result(pa.table({"key": ["plan"], "text": ["one\ntwo"]}), "table").decode().splitlines()
    assert shown[2:4] == ["plan  one", "      two"]


@pytest.mark.parametrize("format", ["table", "markdown"])
def test_control_characters_do_not_reach_a_terminal(format):
    evil = "\x1b]0;title\x07\x9b31mred\r\x08"
    shown = format_result(pa.table({f"n{evil}": [evil]}), format).decode()
    assert not [c for c in shown if c != "\n" and (ord(c) < 32 or 127 <= ord(c) < 160)]
    assert "red" in shown


def test_markdown_escapes_what_would_end_a_cell():
    assert format_result(TABLE.select(["name", "seeds"]), "markdown").decode().splitlines() == [
        "| name | seeds |",
        "| --- | --- |",
        "| alpha | 3 |",
        "| b\\|c | NULL |",
        "| NULL | 10 |",
    ]


def test_csv_keeps_every_digit_and_leaves_null_empty():
    table = pa.table({"x": [0.1 + 0.2, None], "when": [datetime(2026, 1, 2, tzinfo=UTC), None], "widths": [[64, 64], None]})
    read = list(csv.reader(io.StringIO(format_result(table, "csv").decode())))
    assert read == [
        ["x", "when", "widths"],
        ["0.30000000000000004", "2026-01-02T00:00:00+00:00", "[64, 64]"],
        ["", "", ""],
    ]


def test_csv_disarms_formulas_and_leaves_negative_numbers_alone():
    table = pa.table({"text": ["=HYPERLINK(1)", "@x", "ok"], "number": [-1.0, -2.0, 3.0]})
    assert format_result(table, "csv").decode().splitlines()[1:] == ["'=HYPERLINK(1),-1.0", "'@x,-2.0", "ok,3.0"]


@pytest.mark.parametrize("text", ["-1.0", "+.5", "-1e-05", "-3", "-inf", "1.", "nan"])
def test_a_text_that_is_a_number_is_left_alone_in_csv(text):
    assert format_result(pa.table({"value": [text]}), "csv").decode() == f"value\n{text}\n"


@pytest.mark.parametrize("text", ["-1+2", "-1.0\n", "+1e", "--1", "-", "-cmd|x", "+1-1"])
def test_a_text_that_only_begins_as_a_number_is_disarmed(text):
    (row,) = list(csv.reader(io.StringIO(format_result(pa.table({"value": [text]}), "csv").decode())))[1:]
    assert row == [f"'{text}"]


def test_json_is_strict_and_nested_values_keep_their_form():
    rows = json.loads(format_result(TABLE, "json"), parse_constant=pytest.fail)
    assert rows[0] == {
        "name": "alpha",
        "mean": 1.5,
        "seeds": 3,
        "widths": [64, 64],
        "line": {"setting": "a", "mean": None},
    }
    assert rows[1]["mean"] is None


def test_json_numbers_of_any_width_are_numbers():
    table = pa.table({"sum": pa.array([Decimal(12)], pa.decimal128(38, 0)), "half": pa.array([Decimal("0.5")])})
    assert json.loads(format_result(table, "json")) == [{"sum": 12, "half": 0.5}]


def test_parquet_comes_back_as_it_was():
    table = TABLE.drop_columns("mean")  # NaN equals nothing
    assert pq.read_table(io.BytesIO(format_result(table, "parquet"))).to_pylist() == table.to_pylist()


@pytest.mark.parametrize("format", FORMATS)
def test_columns_of_equal_names_are_all_kept(format):
    table = pa.table([pa.array([11]), pa.array([22]), pa.array([33])], names=["a", "a", "a_2"])
    shown = format_result(table, format)
    if format == "parquet":
        shown = str(pq.read_table(io.BytesIO(shown)).to_pydict()).encode()
    assert all(value in shown for value in (b"11", b"22", b"33"))
