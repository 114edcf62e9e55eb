"""What a shard's manifest says, and what it may not say."""

import hashlib
import json

import pyarrow.parquet as pq
import pytest
from small_shards import tables, trial

from sweep import manifest
from sweep.manifest import DamagedError, Manifest
from sweep.store import Store


def say(folder, **said):
    """A manifest with these keys whose checksum is right."""
    content = {"files": {}, "replaces": [], **said}
    checksum = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    (folder / "manifest.json").write_text(json.dumps({"format": 1, **content, "sha256": checksum}))


def test_a_manifest_says_what_the_files_are(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard", tables([0, 1], evaluated=True))
    folder = tmp_path / "shards" / "shard"
    said = json.loads((folder / "manifest.json").read_text())
    found = {
        file.name: {
            "bytes": len(file.read_bytes()),
            "rows": pq.read_table(file, partitioning=None).num_rows,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
        for file in folder.glob("*.parquet")
    }
    assert (said["format"], said["files"], said["replaces"]) == (1, found, [])
    assert said["trials"] == pq.read_table(folder / "trials.parquet", partitioning=None)["trial"].to_pylist()
    assert {name: entry["rows"] for name, entry in found.items()} == {
        "trials.parquet": 2,
        "episodes.parquet": 20,
        "evaluations.parquet": 8,
        "steps.parquet": 2000,
    }


@pytest.mark.parametrize("name", ["", ".", "..", ".staging", "../../precious", "/precious", "a/b", "a/", 5, None])
def test_a_shard_replaces_folders_beside_it_and_nothing_else(tmp_path, name):
    say(tmp_path, replaces=["shard-1", name])
    with pytest.raises(DamagedError, match=r"manifest.json: is damaged: it replaces .*, which can be no shard"):
        manifest.read(tmp_path)
    say(tmp_path, replaces=["shard-1", "..a", "c-0123"][::2])
    assert manifest.read(tmp_path).replaces == ("shard-1", "c-0123")


def test_a_manifest_from_before_trials_were_named_is_read(tmp_path):
    say(tmp_path)
    assert manifest.read(tmp_path) == Manifest({}, ())
    say(tmp_path, trials=["a", "b"])
    assert manifest.read(tmp_path).trials == manifest.trials_said(tmp_path) == ("a", "b")
    for trials in ("ab", [1], None):
        say(tmp_path, trials=trials)
        with pytest.raises(DamagedError, match="cannot be understood"):
            manifest.read(tmp_path)
        assert manifest.trials_said(tmp_path) is None


def test_trials_that_were_changed_or_left_out_are_noticed(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard", tables([0, 1]))
    file = tmp_path / "shards" / "shard" / "manifest.json"
    said = json.loads(file.read_text())
    others = ({**said, "trials": said["trials"][:1]}, {key: value for key, value in said.items() if key != "trials"})
    for changed in others:
        file.write_text(json.dumps(changed))
        with pytest.raises(DamagedError, match="its content is not what was written"):
            manifest.read(file.parent)


@pytest.mark.parametrize("damage", ["trials.parquet", "manifest.json"])
def test_a_damaged_shard_keeps_no_other_from_being_committed(tmp_path, damage):
    """Its trials are known from the manifest, or else from the table: they are not committed again."""
    Store.create(tmp_path).commit("old", tables([0, 1]))
    file = tmp_path / "shards" / "old" / damage
    file.write_bytes(file.read_bytes()[:-40])
    assert Store.open(tmp_path).commit("new", tables([1, 2])) == 1
    with pytest.raises(DamagedError, match=f"old/{damage}: is damaged"):
        Store.open(tmp_path).finished_trials()
    (tmp_path / "shards" / "old" / "manifest.json").write_text("{")
    (tmp_path / "shards" / "old" / "trials.parquet").write_bytes(b"")
    with pytest.raises(DamagedError, match=r"old/trials.parquet: is damaged"):  # nothing says any longer what it holds
        Store.open(tmp_path).commit("newer", tables([0, 3]))
    assert {trial(1).id, trial(3).id}.isdisjoint(manifest.trials_said(tmp_path / "shards" / "new"))


def test_a_flipped_byte_in_the_table_of_trials_is_noticed_before_anything_is_trained(tmp_path):
    Store.create(tmp_path).commit("shard", tables([0, 1]))
    file = tmp_path / "shards" / "shard" / "trials.parquet"
    whole = file.read_bytes()
    for place in range(0, len(whole), 97):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(DamagedError, match=r"trials.parquet: is damaged: its content is not what was written"):
            Store.open(tmp_path).finished_trials()
    file.write_bytes(whole)
    store = Store.open(tmp_path)
    assert store.commit("other", tables([0])) == 0  # what the manifest says is known now
    file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(DamagedError, match=r"trials.parquet: is damaged"):
        store.finished_trials()


def test_what_to_do_about_a_damaged_file_depends_on_what_it_is(tmp_path):
    shard = str(manifest.DamagedError(tmp_path / "shards" / "a" / "trials.parquet", "1 byte"))
    study = str(manifest.DamagedError(tmp_path / "studies" / "a" / "members.parquet", "1 byte"))
    assert "sweep retry" in shard and "launch" not in shard
    assert "launch the study's grid again" in study and "retry" not in study
