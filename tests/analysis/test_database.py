"""A connection: what it finds in a store, and what it is denied."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import small_shards
from synthetic_store import SyntheticStore, build

from agents.hypers import FreeHypers
from agents.registry import ALGORITHMS
from analysis import connect
from analysis.database import view_sources
from analysis.query import short_message
from sweep import schema
from sweep.compaction import compact
from sweep.messages import UserError
from sweep.store import Store
from sweep.trials import Trial

HYPERS = {name for algorithm in ALGORITHMS.values() for name in algorithm.hypers.table}


def columns(connection: duckdb.DuckDBPyConnection, view: str) -> list[str]:
    return [row[0] for row in connection.execute(f"DESCRIBE {view}").fetchall()]


def test_every_table_and_view_of_an_empty_store_is_typed_and_empty(empty_store):
    connection = connect(empty_store)
    names = [row[0] for row in connection.execute("SHOW TABLES").fetchall()]
    tables = {"trials", "episodes", "early_episodes", "evaluations", "steps", "members", "selections", "grid_rules"}
    assert set(names) == tables | view_sources().keys()
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


def test_failed_trials_have_their_identity_and_nothing_else(tmp_path):
    store = Store(SyntheticStore(tmp_path).write_studies())
    store.commit("shard", small_shards.tables([0]))
    store.record_failure("x", [small_shards.trial(0), small_shards.trial(1)], "lost", "node", "gone")
    store.record_failure("y", [Trial("SAC", "Pendulum-CA", FreeHypers(depth="deep"), 7, 5, 1000, 0.99)], "lost", "node", "gone")
    old = {"trials": ["0" * 16], "host": "node", "error": "boom"}
    (tmp_path / "failures" / "old.json").write_text(json.dumps(old))
    connection = connect(tmp_path)
    rows = connection.execute(
        "SELECT seed, status, agent, steps, entropy_scale, hidden_layers, depth, episodes, episode_mean, host"
        " FROM trials ORDER BY seed"
    ).fetchall()
    assert [row[:7] for row in rows] == [
        (0, "finished", "SAC", 1000, 0.01, [64, 64], None),
        (1, "failed", "SAC", 1000, 0.01, [64, 64], None),
        (7, "failed", "SAC", 5, None, None, "deep"),
        (None, "failed", None, None, None, None, None),
    ]
    assert [row[7:] for row in rows[1:]] == [(None, None, None)] * 3
    store.commit("later", small_shards.tables([1]))
    assert connect(tmp_path).execute("SELECT count(*) FROM trials WHERE status = 'failed'").fetchone() == (2,)
    assert connection.execute("SELECT count(*) FROM trials WHERE seed = 1 AND status = 'failed'").fetchone() == (1,)


def test_a_trial_that_failed_twice_has_one_row_and_a_number_beside_texts_is_a_text(tmp_path):
    store = Store(SyntheticStore(tmp_path).write_studies())
    for shard, depth in (("a", 2), ("b", "deep"), ("c", 2)):
        trial = Trial("SAC", "Pendulum-CA", FreeHypers(depth=depth), 7, 5, 1000, 0.99)
        store.record_failure(shard, [trial], "lost", "node", "gone")
    assert connect(tmp_path).execute("SELECT depth FROM trials ORDER BY depth").fetchall() == [("2",), ("deep",)]


def test_selections_of_studies_are_a_table(tmp_path):
    row = dict.fromkeys(schema.SELECTIONS.names) | {
        "study": "demo",
        "agent": "SAC",
        "on_edge": ["entropy_scale"],
        "temperature": 0.5,
    }
    store = SyntheticStore(tmp_path)
    store.plan("demo", "SAC", "Pendulum-CA", 0)
    columns = schema.with_hypers(schema.SELECTIONS, {"temperature": 0.5}, after="setting")
    pq.write_table(pa.Table.from_pylist([row], columns), store.write_studies() / "studies" / "demo" / "selections.parquet")
    found = connect(tmp_path).execute("SELECT study, on_edge, temperature, entropy_scale FROM selections").fetchall()
    assert found == [("demo", ["entropy_scale"], 0.5, None)]


@pytest.mark.parametrize("table", ["trials", "episodes", "steps"])
def test_a_truncated_file_is_named_when_the_store_is_opened(tmp_path, table):
    store = Store.create(tmp_path)
    store.commit("shard", small_shards.tables([0]))
    file = tmp_path / "shards" / "shard" / f"{table}.parquet"
    size = file.stat().st_size
    os.truncate(file, size - 1)
    with pytest.raises(
        UserError, match=f"{table}.parquet: is damaged: {size - 1:,} bytes, {size:,} were written; `sweep verify` says"
    ):
        connect(tmp_path)


def test_a_compacted_store_has_the_same_rows_also_before_the_old_folders_are_gone(tmp_path, monkeypatch):
    store = Store.create(tmp_path)
    for seed in range(3):
        store.commit(f"shard-{seed}", small_shards.tables([seed]))
    queries = [f"SELECT * FROM {table} ORDER BY ALL" for table in ("trials", "episodes", "steps")]
    before = [connect(tmp_path).sql(query).to_arrow_table() for query in queries]
    monkeypatch.setattr(Store, "discard", lambda *_: None)
    compact(store)
    assert len(list(tmp_path.glob("shards/*"))) == 4
    assert [connect(tmp_path).sql(query).to_arrow_table() for query in queries] == before


def test_a_query_that_a_compaction_falls_into_says_so(tmp_path, monkeypatch):
    store = Store.create(tmp_path)
    for seed in range(3):
        store.commit(f"shard-{seed}", small_shards.tables([seed]))
    early = connect(tmp_path)
    compact(store)
    with pytest.raises(duckdb.Error) as error:
        early.execute("SELECT count(DISTINCT episodic_return) FROM steps").fetchall()
    assert short_message(error.value) == "the store was compacted meanwhile: ask again"
    assert connect(tmp_path).execute("SELECT count(*) FROM steps").fetchone() == (3000,)


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


def test_what_was_read_once_stays_as_it_was_and_a_filter_finds_its_rows(tmp_path):
    store = SyntheticStore(tmp_path)
    for seed in range(3):
        store.finish(store.plan("demo", "SAC", "Pendulum-CA", seed, critic_step_size=10.0**-seed), [-1.0 - seed])
    connection = connect(store.write_studies())
    query = "SELECT seed FROM trials WHERE critic_step_size < 0.5 AND episode_mean < -2.5"
    assert connection.execute(query).fetchall() == [(2,)]
    assert connection.execute("SELECT trial, seed FROM run_scores WHERE score = -2").fetchall()[0][1] == 1
    before = [connection.execute(f"FROM {view} ORDER BY ALL").fetchall() for view in ("study_trials", "setting_scores")]
    for file in tmp_path.glob("shards/*/trials.parquet"):
        file.write_bytes(b"")
    assert connection.execute(query).fetchall() == [(2,)]
    assert [connection.execute(f"FROM {view} ORDER BY ALL").fetchall() for view in ("study_trials", "setting_scores")] == before
    with pytest.raises(duckdb.Error, match="registered as 'trials' failed"):
        connection.execute("SELECT host FROM trials").fetchall()


def test_all_columns_of_a_table_are_in_their_places_whatever_was_asked_for_before(small_store):
    fresh, used = connect(small_store), connect(small_store)
    for columns in ("status, agent", "seed", "trial"):
        used.execute(f"SELECT {columns} FROM trials WHERE episode_mean > 0").fetchall()
    whole = "FROM trials ORDER BY trial"
    assert used.sql(whole).to_arrow_table() == fresh.sql(whole).to_arrow_table()


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
