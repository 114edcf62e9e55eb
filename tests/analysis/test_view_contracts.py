"""What holds for every file in `analysis/sql`."""

import re

import pytest

from analysis.database import view_sources

SOURCES = view_sources()


@pytest.mark.parametrize("name", SOURCES)
def test_the_first_line_says_what_a_row_is(name):
    assert re.match(r"-- One row per \(\w+(, \w+)*\)\.\n", SOURCES[name])


@pytest.mark.parametrize("name", SOURCES)
def test_a_row_is_what_the_first_line_says(name, connection):
    names = re.match(r"-- One row per \((.*)\)", SOURCES[name])[1].split(", ")
    grain = ", ".join(f'"{column}"' for column in names)
    count, distinct = connection.execute(
        f"SELECT (SELECT count(*) FROM {name}), (SELECT count(*) FROM (SELECT DISTINCT {grain} FROM {name}))"
    ).fetchone()
    assert count == distinct > 0


@pytest.mark.parametrize("name", SOURCES)
def test_keywords_are_upper_case(name):
    code = re.sub(r"--.*|'[^']*'", "", SOURCES[name])
    assert not re.findall(r"\b(?:select|from|where|join|group by|order by|with|as|case|when|and|on)\b", code)


def test_a_view_comes_after_those_it_reads():
    order = list(SOURCES)
    for earlier, later in [("settings", "sensitivity_lines"), ("sensitivity_lines", "sensitivity_regions")]:
        assert order.index(earlier) < order.index(later)
