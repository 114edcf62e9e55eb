"""What lies in a store's files, of shards and of studies, how large it is, and what is said when it is damaged."""

import os
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from small_shards import tables, trial

from sweep.messages import UserError
from sweep.store import Store
from sweep.tables import members_table

ROOT = Path(__file__).parent.parent.parent


def test_steps_cost_about_as_much_as_the_episodes(tmp_path):
    """100,000 rows a trial: 1.2 MB in memory, and two kilobytes on disk."""
    store = Store.create(tmp_path)
    store.commit("shard", tables(range(16), steps=100_000, length=200))
    file = tmp_path / "shards" / "shard" / "steps.parquet"
    assert file.stat().st_size / 16 < 16 * 500 + 1000
    metadata = pq.ParquetFile(file).metadata
    assert metadata.num_rows == 1_600_000
    columns = {metadata.row_group(0).column(i).path_in_schema: metadata.row_group(0).column(i).encodings for i in range(3)}
    assert "DELTA_BINARY_PACKED" in columns["step"]
    assert "RLE_DICTIONARY" in columns["episodic_return"]
    episodes = file.parent / "episodes.parquet"
    print(f"steps {file.stat().st_size / 16:.0f} bytes a trial, episodes {episodes.stat().st_size / 16:.0f}")


def test_row_groups_of_steps_hold_100_000_rows_whether_trials_are_long_or_short(tmp_path):
    store = Store.create(tmp_path)
    store.commit("long", tables([0], steps=250_000, length=1000))
    store.commit("short", tables(range(1, 251), steps=1000))
    for shard in ("long", "short"):
        metadata = pq.ParquetFile(tmp_path / "shards" / shard / "steps.parquet").metadata
        assert [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)] == [100_000, 100_000, 50_000]


MEMORY = """
import resource, sys
from sweep.store import Store
from small_shards import tables

store = Store.create(sys.argv[1])
store.commit("small", tables([0], steps=100_000, length=1000))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
large = tables(range(256), steps=100_000, length=1000)
assert store.commit("large", large) == 255
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def test_memory_does_not_grow_with_the_steps_that_are_committed(tmp_path):
    """25.6 million rows, 300 MB, written twice because one of the trials is there already."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support")])
    command = [sys.executable, "-c", MEMORY, str(tmp_path / "store")]
    ran = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    assert int(ran.stdout) < 100
    assert pq.ParquetFile(tmp_path / "store" / "shards" / "large" / "steps.parquet").metadata.num_rows == 25_500_000


def test_writing_the_same_study_again_touches_no_file(tmp_path):
    store = Store.create(tmp_path)
    members = members_table("study", {"tune": [trial(0)]})
    store.write_study("study", "text", members, ["study.steps=5"])
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "studies" / "study").iterdir()}
    store.write_study("study", "text", members, ["study.steps=5"])
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "studies" / "study").iterdir()} == before
    assert sorted(file.name for file in before) == ["grid.toml", "members.parquet", "overrides.json"]


def test_a_studys_grid_overrides_and_trials_are_read_as_they_were_written(tmp_path):
    store = Store.create(tmp_path)
    assert store.studies() == []
    members = members_table("study-b", {"tune": [trial(0), trial(1)], "evaluate": [trial(1), trial(2)]})
    store.write_study("study-b", 'name = "τ"\n', members, ("study.steps=5", "a=b"))
    store.write_study("study-a", "", members_table("study-a", {}))
    assert store.studies() == ["study-a", "study-b"]
    assert store.study_source("study-b") == ('name = "τ"\n', ("study.steps=5", "a=b"))
    assert store.study_trials("study-b") == {trial(seed).id for seed in (0, 1, 2)}
    assert store.study_trials("study-b", "evaluate") == {trial(seed).id for seed in (1, 2)}
    assert store.study_trials("study-a") == store.study_trials("study-c") == set()
    store.write_study("study-b", "", members)
    assert store.study_source("study-b") == ("", ())
    assert not (tmp_path / "studies" / "study-b" / "overrides.json").exists()


def test_an_unknown_study_is_a_users_mistake_and_the_nearest_is_named(tmp_path):
    store = Store.create(tmp_path)
    with pytest.raises(UserError, match='there is no study "x" in this store; it has no study yet'):
        store.study_source("x")
    store.write_study("entropy-scale", "", members_table("entropy-scale", {}))
    with pytest.raises(UserError, match='there is no study "entropy-scal" in this store; did you mean "entropy-scale"'):
        store.study_source("entropy-scal")
    (tmp_path / "studies" / "entropy-scale" / "overrides.json").write_text('{"a": 1}')
    with pytest.raises(UserError, match=r"entropy-scale: is damaged .*overrides.json is no list of texts"):
        store.study_source("entropy-scale")


def test_a_truncated_or_missing_file_is_named_before_anything_is_trained(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard", tables([0]))
    file = tmp_path / "shards" / "shard" / "steps.parquet"
    content = file.read_bytes()
    file.write_bytes(content[:-100])
    advice = "`sweep verify` says what else is, `sweep retry` trains it again"
    with pytest.raises(UserError) as error:
        Store.open(tmp_path).finished_trials()
    assert str(error.value) == f"{file}: is damaged: {len(content) - 100:,} bytes, {len(content):,} were written; {advice}"
    file.unlink()
    with pytest.raises(UserError) as error:
        Store.open(tmp_path).finished_trials()
    assert str(error.value) == f"{file}: is damaged: it is missing, {len(content):,} bytes were written; {advice}"
    assert store.commit("other", tables([1])) == 1  # which trials there are is known: nothing is lost meanwhile
    (file.parent / "trials.parquet").write_bytes(b"")
    (file.parent / "manifest.json").unlink()
    with pytest.raises(UserError, match=r"trials.parquet: is damaged"):
        Store.open(tmp_path).commit("third", tables([0, 2]))
