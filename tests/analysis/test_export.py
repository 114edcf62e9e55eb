"""`sweep export`: a study's rows as files that pandas, polars and DuckDB read without this package."""

import csv
import hashlib
import io
import json
import math

import duckdb
import pandas as pd
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from synthetic_store import SyntheticStore

from analysis import connect, export
from analysis.formats import format_result
from sweep.messages import UserError

TABLES = ("trials", "episodes", "evaluations", "members", "selections")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Studies "first" (2 trials, one of them shared with "second") and "second" (2 trials, one diverged)."""
    made = SyntheticStore(tmp_path_factory.mktemp("export") / "store")
    shared = made.plan("first", "SAC", "Pendulum-CA", 0, critic_step_size=0.1)
    made.finish(shared, [10, 20], host="=cmd|' /C calc'!A0")
    own = made.plan("first", "SAC", "Pendulum-CA", 1, critic_step_size=0.1)
    made.finish(own, [30, 40])
    made.plan("second", "SAC", "Pendulum-CA", 0, critic_step_size=0.1)
    other = made.plan("second", "SAC", "Pendulum-CA", 2, critic_step_size=0.1)
    made.finish(other, [5, math.nan])
    return made.write_studies()


@pytest.mark.parametrize("format", export.FORMATS)
def test_every_table_and_view_of_a_study_becomes_a_file(store, format, tmp_path):
    written = export.export(store, ["first"], tmp_path / "out", format)
    assert {one.file.name for one in written} == {f"{name}.{format}" for name in export.RELATIONS}
    assert {file.name for file in (tmp_path / "out").iterdir()} == {one.file.name for one in written} | {"export.json"}
    rows = {one.relation: one.rows for one in written}
    assert (rows["trials"], rows["members"], rows["episodes"], rows["study_trials"]) == (2, 2, 4, 2)


def test_every_relation_that_is_named_exists_and_is_sorted_by_columns_that_it_has(store):
    connection = connect(store)
    for relation, order in (export._OF_TRIALS | export._OF_STUDIES).items():
        assert {*order} <= {row[0] for row in connection.execute(f"DESCRIBE {relation}").fetchall()}, relation


def test_a_study_has_the_trials_that_it_shares_with_others_and_no_other(store, tmp_path):
    export.export(store, ["second"], tmp_path)
    trials = pd.read_parquet(tmp_path / "trials.parquet")
    members = pd.read_parquet(tmp_path / "members.parquet")
    assert sorted(trials["seed"]) == [0, 2] == sorted(members["seed"])
    assert set(members["study"]) == {"second"}
    episodes = pd.read_parquet(tmp_path / "episodes.parquet")
    assert sorted(episodes["episodic_return"].dropna()) == [5, 10, 20]
    assert episodes["episodic_return"].isna().sum() == 1


def test_several_studies_are_exported_together_and_a_shared_trial_is_one_row(store, tmp_path):
    written = {one.relation: one.rows for one in export.export(store, ["first", "second"], tmp_path)}
    assert (written["trials"], written["members"]) == (3, 4)


def test_steps_come_only_when_asked_for_and_in_order(store, tmp_path):
    export.export(store, ["first"], tmp_path / "without")
    assert not (tmp_path / "without" / "steps.parquet").exists()
    export.export(store, ["first"], tmp_path / "with", steps=True)
    steps = pl.read_parquet(tmp_path / "with" / "steps.parquet")
    assert steps.height == 2_000
    for _, of_trial in steps.group_by("trial"):
        assert of_trial["step"].to_list() == list(range(1, 1_001))


def test_parquet_keeps_types_and_csv_says_the_same_in_text(store, tmp_path):
    export.export(store, ["first"], tmp_path / "p")
    export.export(store, ["first"], tmp_path / "c", "csv")
    types = pq.read_schema(tmp_path / "p" / "trials.parquet")
    assert pa.types.is_timestamp(types.field("finished_at").type)
    assert pa.types.is_list(types.field("hidden_layers").type)
    expected = pd.read_parquet(tmp_path / "p" / "trials.parquet")
    text = pd.read_csv(tmp_path / "c" / "trials.csv")
    assert list(text.columns) == list(expected.columns)
    assert text["trial"].tolist() == expected["trial"].tolist()
    assert text["episode_mean"].tolist() == expected["episode_mean"].tolist() == [*expected["episode_mean"]]
    assert [json.loads(value) for value in text["hidden_layers"]] == [list(value) for value in expected["hidden_layers"]]
    assert text["finished_at"][0] == "2026-01-01T00:00:00+00:00"
    assert text["commit"].isna().all()


def test_a_text_that_a_spreadsheet_would_run_as_a_formula_is_quoted_in_csv_alone(store, tmp_path):
    export.export(store, ["first"], tmp_path / "p")
    export.export(store, ["first"], tmp_path / "c", "csv")
    hostile = "=cmd|' /C calc'!A0"
    assert hostile in pd.read_parquet(tmp_path / "p" / "trials.parquet")["host"].tolist()
    assert f"'{hostile}" in pd.read_csv(tmp_path / "c" / "trials.csv")["host"].tolist()


def test_texts_are_disarmed_as_sweep_sql_does_and_numbers_are_not():
    texts = ["-1.0", "+.5", "-1e-05", "-inf", "-1+2", "-1.0\n", "--1", "-", "@x", "=1", "ok", "", None]
    exported = export._csv_column(pa.array(texts)).to_pylist()
    expected = list(csv.reader(io.StringIO(format_result(pa.table({"text": texts}), "csv").decode())))[1:]
    assert exported[:5] == ["-1.0", "+.5", "-1e-05", "-inf", "'-1+2"]
    assert [text or "" for text in exported] == [row[0] if row else "" for row in expected]


def test_rows_of_trials_are_asked_for_by_name_in_chunks(store, tmp_path, monkeypatch):
    whole = export.export(store, ["first", "second"], tmp_path / "whole", steps=True)
    monkeypatch.setattr(export, "_MOST_TRIALS", 2)
    queries = export._queries(connect(store), "episodes", ["first", "second"])
    assert [(query.count("SELECT"), query.count("', '")) for query in queries] == [(1, 1), (1, 0)]
    chunks = export.export(store, ["first", "second"], tmp_path / "chunks", steps=True)
    assert [one.rows for one in chunks] == [one.rows for one in whole]
    for name in ("trials", "episodes", "steps"):
        read = [pl.read_parquet(tmp_path / folder / f"{name}.parquet") for folder in ("whole", "chunks")]
        keys = [column for column in ("trial", "episode", "step") if column in read[0].columns]
        assert read[0].sort(keys).equals(read[1].sort(keys)), name
    assert pl.read_parquet(tmp_path / "chunks" / "trials.parquet")["trial"].is_sorted()


def test_the_table_of_contents_has_rows_columns_and_checksums(store, tmp_path):
    export.export(store, ["first"], tmp_path)
    contents = json.loads((tmp_path / "export.json").read_text())
    assert (contents["studies"], contents["format"]) == (["first"], "parquet")
    for one in contents["files"]:
        content = (tmp_path / one["file"]).read_bytes()
        assert (one["bytes"], one["sha256"]) == (len(content), hashlib.sha256(content).hexdigest())
        assert list(one["columns"]) == pq.read_schema(tmp_path / one["file"]).names
        assert one["rows"] == pq.read_metadata(tmp_path / one["file"]).num_rows


def test_plain_duckdb_answers_from_the_files(store, tmp_path):
    export.export(store, ["first"], tmp_path)
    query = f"SELECT AVG(episodic_return) FROM '{tmp_path}/episodes.parquet' JOIN '{tmp_path}/trials.parquet' USING (trial)"
    assert duckdb.sql(query).fetchall() == [(25.0,)]


def test_a_folder_with_files_is_left_alone_unless_forced(store, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "trials.parquet").write_text("old")
    with pytest.raises(UserError, match="has files already: choose an empty folder, or --force"):
        export.export(store, ["first"], tmp_path)
    assert (tmp_path / "trials.parquet").read_text() == "old"
    export.export(store, ["first"], tmp_path, force=True)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert len(pd.read_parquet(tmp_path / "trials.parquet")) == 2


def test_nothing_is_written_into_the_store(store, tmp_path):
    before = sorted(store.rglob("*"))
    (tmp_path / "link").symlink_to(store)
    for place in (store, store / "export", tmp_path / "link" / "export"):
        with pytest.raises(UserError, match="is in the store"):
            export.export(store, ["first"], place, force=True)
    assert sorted(store.rglob("*")) == before


def test_a_place_that_is_no_folder_and_a_format_that_is_none_are_refused(store, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="is no folder"):
        export.export(store, ["first"], tmp_path / "file")
    with pytest.raises(UserError, match='unknown format "parket": did you mean "parquet"'):
        export.export(store, ["first"], tmp_path / "out", "parket")
    with pytest.raises(UserError, match="cannot be written there"):
        export.export(store, ["first"], tmp_path / "file" / "below")
    assert not (tmp_path / "out").exists()


def test_a_file_that_cannot_be_finished_leaves_the_earlier_one_and_nothing_else(store, tmp_path, monkeypatch):
    export.export(store, ["first"], tmp_path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    def full(batches, sink):
        sink.write(b"half a file")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(export, "_write_parquet", full)
    with pytest.raises(UserError, match="cannot be written there: No space left"):
        export.export(store, ["first"], tmp_path, force=True)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_a_study_without_any_trial_yet_has_files_without_rows(tmp_path):
    made = SyntheticStore(tmp_path / "store")
    made.plan("new", "SAC", "Pendulum-CA", 0)
    written = {one.relation: one.rows for one in export.export(made.write_studies(), ["new"], tmp_path / "out")}
    assert (written["members"], written["trials"], written["episodes"]) == (1, 0, 0)
    assert pd.read_parquet(tmp_path / "out" / "trials.parquet").empty


def test_rows_of_the_real_store_are_all_there(real_store, tmp_path):
    connection = connect(real_store)
    studies = [row[0] for row in connection.execute("SELECT DISTINCT study FROM members ORDER BY study").fetchall()]
    written = {one.relation: one.rows for one in export.export(real_store, studies, tmp_path)}
    for relation in TABLES:
        assert written[relation] == connection.execute(f"SELECT COUNT(*) FROM {relation}").fetchall()[0][0], relation
    assert written["learning_curve_changes"] > 0
