"""A connection: what it finds in a store, and what it is denied."""

import math
import subprocess
import sys
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic_store import SyntheticStore, build

from agents.registry import ALGORITHMS
from analysis import connect
from analysis.database import view_sources
from sweep import schema
from sweep.messages import UserError

HYPERS = {name for algorithm in ALGORITHMS.values() for name in algorithm.hypers.table}


def columns(connection: duckdb.DuckDBPyConnection, view: str) -> list[str]:
    return [row[0] for row in connection.execute(f"DESCRIBE {view}").fetchall()]


def test_every_table_and_view_of_an_empty_store_is_typed_and_empty(empty_store):
    connection = connect(empty_store)
    names = [row[0] for row in connection.execute("SHOW TABLES").fetchall()]
    assert set(names) == {"trials", "episodes", "evaluations", "steps", "members"} | view_sources().keys()
    filled = [name for name in names if connection.execute(f"SELECT count(*) FROM {name}").fetchone()[0]]
    assert filled == ["student_quantiles"]


@pytest.mark.parametrize("view", ["trials", "members", "settings"])
def test_hyperparameters_of_every_algorithm_are_columns_even_where_no_file_has_them(view, empty_store):
    assert set(columns(connect(empty_store), view)) >= HYPERS


def test_columns_are_those_of_the_schema(connection):
    assert set(columns(connection, "trials")) == set(schema.TRIALS.names) | HYPERS
    assert columns(connection, "episodes") == schema.EPISODES.names
    assert columns(connection, "steps") == schema.STEPS.names
    assert set(columns(connection, "members")) == set(schema.MEMBERS.names) | HYPERS


def test_a_hyperparameter_of_an_unregistered_algorithm_becomes_a_column(tmp_path):
    store = SyntheticStore(tmp_path)
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 0, temperature=0.5), [1.0])
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 1), [1.0])
    connection = connect(store.write_studies())
    assert connection.execute("SELECT temperature FROM trials ORDER BY seed").fetchall() == [(0.5,), (None,)]
    assert connection.execute("SELECT count(temperature), count(*) FROM settings").fetchall() == [(1, 2)]


def test_a_path_with_a_space_a_quote_and_glob_characters_works(tmp_path):
    path = build(tmp_path / "it's a [1] store*?")
    assert connect(path).execute("SELECT count(*) FROM trials").fetchone()[0] == 16
    assert connect(str(path)).execute("SELECT count(*) FROM steps").fetchone()[0] > 0


def test_a_missing_store_is_a_users_mistake(tmp_path):
    with pytest.raises(UserError, match="nowhere"):
        connect(tmp_path / "nowhere")


def test_staged_shards_are_not_read(small_store, tmp_path):
    path = build(tmp_path / "store")
    (path / "shards" / "shard-0000").rename(path / ".staging")
    assert connect(path).execute("SELECT count(*) FROM trials").fetchone()[0] == 15


def test_a_connection_keeps_to_the_shards_that_were_there_when_it_was_opened(tmp_path):
    store = SyntheticStore(tmp_path)
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 0), [1.0])
    early = connect(store.write_studies())
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 1), [1.0])
    assert early.execute("SELECT count(*) FROM trials").fetchone() == (1,)
    assert connect(tmp_path).execute("SELECT count(*) FROM trials").fetchone() == (2,)


def test_the_number_of_threads_is_as_asked(small_store):
    assert connect(small_store, threads=1).execute("SELECT current_setting('threads')").fetchone() == (1,)


def test_rows_with_nan_are_found_by_a_filter(connection):
    assert connection.execute("SELECT count(*) FROM episodes WHERE isnan(episodic_return)").fetchone() == (2,)
    assert connection.execute("SELECT count(*) FROM episodes WHERE NOT isfinite(episodic_return)").fetchone() == (2,)


def test_a_flipped_bit_is_an_error_rather_than_a_wrong_number(tmp_path):
    store = SyntheticStore(tmp_path)
    store.finish(store.plan("demo", "SAC", "Pendulum-CA", 0), [float(value) for value in range(100)])
    connection = connect(store.write_studies())
    (file,) = tmp_path.glob("shards/*/episodes.parquet")
    column = pq.ParquetFile(file).metadata.row_group(0).column(schema.EPISODES.get_field_index("episodic_return"))
    whole, sums, errors = file.read_bytes(), set(), 0
    for position in range(column.dictionary_page_offset, column.dictionary_page_offset + column.total_compressed_size, 9):
        file.write_bytes(whole[:position] + bytes([whole[position] ^ 4]) + whole[position + 1 :])
        try:
            sums.add(connection.execute("SELECT sum(episodic_return) FROM episodes").fetchone()[0])
        except duckdb.Error:
            errors += 1
    assert errors > 40
    assert sums <= {4950.0}  # a flip that does no harm: in a field of the page's header that nothing reads


def test_an_unreadable_shard_is_named(small_store, tmp_path):
    path = build(tmp_path / "store")
    (path / "shards" / "shard-0003" / "trials.parquet").write_bytes(b"no Parquet")
    with pytest.raises(UserError, match=r"shard-0003.*cannot be read"):
        connect(path)


@pytest.mark.parametrize(
    "sql",
    [
        "COPY (SELECT 1) TO '{store}/new.csv'",
        "WITH x AS (COPY (SELECT 1) TO '{store}/new.csv') SELECT 1",
        "EXPLAIN ANALYZE COPY (SELECT 1) TO '{store}/new.csv'",
        "ATTACH '{store}/new.db'",
        "SELECT * FROM read_text('/etc/passwd')",
        "SELECT * FROM read_text('{store}/../../../../../../etc/passwd')",
        "SELECT * FROM read_text('{store}/sweep-store.json')",
        "SELECT * FROM glob('/*')",
        "SELECT * FROM '/etc/passwd'",
        "INSTALL httpfs",
        "LOAD httpfs",
        "SET enable_external_access = true",
        "SET threads = 1",
        "RESET lock_configuration",
        "SELECT getenv('HOME')",
        "SELECT * FROM enable_logging(storage = 'file')",
        "SELECT * FROM sys",
        "INSERT INTO trials (trial) VALUES ('x')",
        "DELETE FROM trials",
    ],
)
def test_a_connection_reaches_no_file_and_no_setting(sql, small_store, connection):
    before = {file: file.stat().st_mtime_ns for file in small_store.rglob("*")}
    with pytest.raises(duckdb.Error):
        connection.execute(sql.format(store=small_store)).fetchall()
    assert {file: file.stat().st_mtime_ns for file in small_store.rglob("*")} == before


def test_a_variable_of_the_program_is_no_table(small_store):
    frame = pa.table({"a": [1]})
    with pytest.raises(duckdb.CatalogException, match="frame"):
        connect(small_store).sql("FROM frame")
    assert frame.num_rows == 1


def test_scores_do_not_depend_on_the_number_of_threads(small_store):
    one, two = (connect(small_store, threads=n).execute("FROM settings ORDER BY ALL").fetchall() for n in (1, 2))
    assert one == two
    assert not any(isinstance(value, float) and math.isnan(value) for row in one for value in row)


def test_analysis_loads_neither_torch_nor_ray_and_matplotlib_only_to_draw():
    code = (
        "import sys, analysis, analysis.query, analysis.analyze\n"
        "print([name for name in ('torch', 'ray', 'gymnasium', 'cluster', 'matplotlib') if name in sys.modules])"
    )
    root = Path(__file__).resolve().parents[2]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=True, capture_output=True).stdout == b"[]\n"
