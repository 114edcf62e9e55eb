"""Every query and every program of `docs/sql.md`, run on a small store."""

import math
import re
from pathlib import Path

import pytest
from synthetic_store import SyntheticStore

from analysis import connect
from analysis.database import view_sources
from analysis.query import run_query

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "sql.md").read_text("utf-8")
QUERIES = re.findall(r"```sql\n(.*?)```", PAGE, re.DOTALL)
PROGRAMS = [text for text in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "analysis" not in text]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Two studies that share settings; one trial diverged."""
    synthetic = SyntheticStore(tmp_path_factory.mktemp("cookbook"))
    for agent in ("SAC", "GreedyAC"):
        for study in ("first", "second"):
            for x in (0.1, 0.01, 0.001):
                for seed in range(2):
                    member = synthetic.plan(study, agent, "Pendulum-CA", seed + 2 * (study == "second"), critic_step_size=x)
                    diverged = x == 0.1 and seed == 0
                    synthetic.finish(member, [-9.0 - seed, math.nan if diverged else 100 * x], host="node")
    return synthetic.write_studies()


@pytest.mark.parametrize("query", QUERIES, ids=lambda query: query.split("FROM ")[1].split()[0])
def test_a_query_of_the_page_has_an_answer(store, query):
    assert run_query(store, query).num_rows > 0


def test_the_page_asks_a_dozen_questions():
    assert len(QUERIES) >= 12
    assert len(re.findall(r"^\*\*.*\?\*\*", PAGE, re.MULTILINE)) == len(QUERIES)


def test_the_page_lists_every_table_and_view(store):
    listed = re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE)
    connection = connect(store)
    assert sorted(listed) == sorted(row[0] for row in connection.execute("SHOW TABLES").fetchall())
    connection.close()


def test_the_page_says_what_a_row_of_a_view_is():
    said = dict(re.findall(r"^\| `(\w+)` \| (\w[\w, ]*) \|", PAGE, re.MULTILINE))
    for view, select in view_sources().items():
        assert said[view] == re.match(r"-- One row per \((.*)\)", select)[1], view


@pytest.mark.parametrize(("program", "columns"), list(zip(PROGRAMS, ("trials", "count", "episodic_return"), strict=True)))
def test_a_store_can_be_read_without_this_package(store, program, columns, capsys):
    exec(program, {"store": str(store)})
    shown = capsys.readouterr().out
    assert columns in shown
    if columns != "episodic_return":
        assert "GreedyAC" in shown and "SAC" in shown
