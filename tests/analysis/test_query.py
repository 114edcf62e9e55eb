"""`sweep sql`: one statement that reads, and a short message about any other."""

import io
import json
from pathlib import Path

import pytest

from analysis.query import run, run_query
from sweep.messages import UserError


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT count(*) FROM trials",
        "FROM trials;",
        "WITH x AS (SELECT 1) SELECT * FROM x",
        "VALUES (1)",
        "DESCRIBE trials",
        "SHOW TABLES",
        "SUMMARIZE best_returns",
        "PIVOT study_trials ON status IN ('finished') USING count(*)",
        "EXPLAIN SELECT 1",
        "explain analyze select 1",
        "-- a comment\nSELECT 1",
        "  EXPLAIN\nFROM trials",
        "TABLE trials",
    ],
)
def test_reading_statements_run(sql, small_store):
    assert run_query(small_store, sql).num_columns > 0


@pytest.mark.parametrize(
    ("sql", "message"),
    [
        ("COPY trials TO 'x.csv'", "COPY is not allowed"),
        ("EXPLAIN COPY trials TO 'x.csv'", "for one SELECT"),
        ("EXPLAIN ANALYZE COPY (SELECT 1) TO '{store}/x.csv'", "for one SELECT"),
        ("EXPLAIN /* so */ ANALYZE COPY (SELECT 1) TO '{store}/x.csv'", "for one SELECT"),
        ("/* so */ EXPLAIN ANALYZE COPY (SELECT 1) TO '{store}/x.csv'", "for one SELECT"),
        ("EXPLAIN (ANALYZE) COPY (SELECT 1) TO '{store}/x.csv'", "for one SELECT"),
        ("EXPLAIN ANALYZE CREATE TABLE x (a INT)", "for one SELECT"),
        ("WITH x AS (COPY (SELECT 1) TO '{store}/x.csv') SELECT 1", "Cannot access file"),
        ("ATTACH 'x.db'", "ATTACH is not allowed"),
        ("INSTALL httpfs", "LOAD is not allowed"),
        ("PRAGMA version", "PRAGMA is not allowed"),
        ("CALL pragma_version()", "CALL is not allowed"),
        ("SET threads = 1", "SET is not allowed"),
        ("CREATE TABLE x (a INT)", "CREATE is not allowed"),
        ("DROP VIEW settings", "DROP is not allowed"),
        ("INSERT INTO trials VALUES (1)", "INSERT is not allowed"),
        ("EXPORT DATABASE 'x'", "EXPORT is not allowed"),
        ("BEGIN", "TRANSACTION is not allowed"),
        ("PIVOT study_trials ON status USING count(*)", r"ON column IN \(value"),
        ("SELECT 1; SELECT 2", "2 statements"),
        ("SELECT 1; DROP VIEW settings", "2 statements"),
        ("", "the query is empty"),
        ("-- nothing", "the query is empty"),
        ("SELECT * FROM read_text('/etc/passwd')", "Cannot access file"),
        ("SELECT * FROM read_text('{store}/../../../../../../etc/passwd')", "Cannot access file"),
        ("FROM '/etc/passwd'", "does not exist"),
    ],
)
def test_anything_else_is_refused_with_a_reason_and_writes_nothing(sql, message, small_store, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = sorted(small_store.rglob("*"))
    with pytest.raises(UserError, match=message):
        run_query(small_store, sql.format(store=small_store))
    assert sorted(small_store.rglob("*")) == before
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("sql", "message"),
    [
        ("SELEC 1", 'SQL: syntax error at or near "selec"'),
        ("SELECT 1 FROM trialz", 'SQL: Table with name trialz does not exist! Did you mean "trials"?'),
        ("SELECT 'a'::INT", "SQL: Could not convert string 'a' to INT32"),
        ("SELECT $1", "SQL: Values were not provided for the following parameters: 1"),
    ],
)
def test_wrong_sql_is_answered_in_one_line(sql, message, small_store):
    with pytest.raises(UserError) as caught:
        run_query(small_store, sql)
    assert str(caught.value).casefold() == message.casefold()
    assert caught.value.__cause__ is None


def test_a_misspelled_column_is_answered_with_candidates(small_store):
    with pytest.raises(UserError, match=r'"trail" not found in FROM clause! Candidate bindings: "trial"[^\n]*$'):
        run_query(small_store, "SELECT trail FROM trials")


def test_an_unknown_format_is_answered_with_the_known_ones(small_store):
    with pytest.raises(UserError, match='did you mean "markdown"'):
        run(small_store, "SELECT 1", "markdwn")


def test_the_result_goes_to_the_given_stream(small_store):
    out = io.BytesIO()
    run(small_store, "SELECT environment, best_return FROM best_returns", "json", out)
    assert json.loads(out.getvalue()) == [{"environment": "Pendulum-CA", "best_return": 60.0}]


def test_the_result_goes_to_standard_output_by_default(small_store, capsysbinary):
    run(small_store, "SELECT 1 AS one", "csv")
    assert capsysbinary.readouterr().out == b"one\n1\n"


def test_a_sort_larger_than_memory_leaves_nothing_behind_in_the_working_directory(small_store, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_query(small_store, "SELECT step FROM steps ORDER BY episodic_return, step LIMIT 1")
    assert not list(Path.cwd().iterdir())
