"""`sweep verify`, `compact` and `merge` as a user sees them."""

import json
import os

import pytest
import typer
from small_shards import rows, tables, trial
from typer.testing import CliRunner

from sweep.commands import upkeep
from sweep.messages import UserError
from sweep.store import Store
from sweep.tables import members_table

app = typer.Typer()
for command in (upkeep.verify, upkeep.compact, upkeep.merge):
    app.command()(command)


def sweep(*arguments):
    """Exit code and output of a command. A UserError is raised, as the command line's `main` expects."""
    ran = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if isinstance(ran.exception, UserError):
        raise ran.exception
    return ran.exit_code, ran.stdout


@pytest.fixture
def store(tmp_path):
    made = Store.create(tmp_path / "results")
    for number in range(3):
        made.commit(f"shard-{number}", tables([2 * number, 2 * number + 1]))
    return made


def flip(file):
    content = file.read_bytes()
    file.write_bytes(content[:100] + bytes([content[100] ^ 1]) + content[101:])


def test_verify_says_that_all_is_well(store):
    size = sum(file.stat().st_size for file in store.path.glob("shards/*/*"))
    assert sweep("verify", "--store", store.path) == (0, f"All is well: 3 shards, 6 trials, {size / 1e3:,.1f} kB.\n")


def test_verify_names_damaged_files_and_what_to_do_about_them(store):
    flip(store.path / "shards" / "shard-1" / "steps.parquet")
    (store.path / "shards" / "shard-2" / "episodes.parquet").unlink()
    store.write_study("study", "", members_table("study", {"tune": [trial(0)]}))
    (store.path / "studies" / "study" / "members.parquet").write_bytes(b"")
    code, out = sweep("verify", "--store", store.path)
    assert code == 2
    lines = [line.split() for line in out.splitlines()]
    assert lines[0] == ["shard", "file", "trials", "what", "is", "wrong"]
    assert lines[2] == ["shard-1", "steps.parquet", "2", "its", "content", "is", "not", "what", "was", "written", "(SHA-256)"]
    assert lines[3] == ["shard-2", "episodes.parquet", "2", "it", "is", "missing"]
    assert lines[4][0] == "studies/study/members.parquet"
    assert (
        "2 of 3 shards are damaged: 4 of 6 trials.\n`sweep retry` puts damaged shards aside and trains their trials again." in out
    )
    assert "remove it, and launch the study's grid again" in out


def test_verify_mentions_what_is_no_damage(store):
    (store.path / "shards" / "shard-0" / "manifest.json").unlink()
    left = store.path / ".staging" / "shard-host-1-abc"
    left.mkdir()
    os.utime(left, (0, 0))
    target = store.quarantine("shard-1")
    code, out = sweep("verify", "--store", store.path)
    assert code == 0
    assert "1 shard without checksums, written before there were any." in out
    assert f"1 leftover of processes that were killed; nothing reads them:\n  {left}\n" in out
    assert f"1 shard put aside earlier; nothing reads them:\n  {target}\n" in out


def test_verify_as_json(store):
    flip(store.path / "shards" / "shard-1" / "steps.parquet")
    code, out = sweep("verify", "--store", store.path, "--quick", "--json")
    found = json.loads(out)
    assert (code, found["shards"], found["trials"], found["damaged_trials"]) == (2, 3, 6, 2)
    (problem,) = found["problems"]
    assert (problem["shard"], sorted(problem["trials"])) == ("shard-1", sorted([trial(2).id, trial(3).id]))
    assert problem["file"].endswith("shards/shard-1/steps.parquet")


def test_a_store_that_is_not_there_is_a_users_mistake(tmp_path):
    for command in ("verify", "compact"):
        with pytest.raises(UserError, match="there is no store here"):
            sweep(command, "--store", tmp_path / "missing")
    with pytest.raises(UserError, match=r"missing: there is no store here"):
        sweep("merge", tmp_path / "missing", "--store", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_compact_says_what_became_of_the_shards(store):
    code, out = sweep("compact", "--store", store.path)
    assert (code, out.startswith("3 shards became 1, ")) == (0, True)
    assert out.endswith("; 6 trials moved, none changed.\n")
    code, out = sweep("compact", "--store", store.path)
    assert (code, out.startswith("Nothing to put together: 1 shard, ")) == (0, True)


def test_compact_leaves_damaged_shards_alone_and_says_so(store):
    flip(store.path / "shards" / "shard-1" / "steps.parquet")
    code, out = sweep("compact", "--store", store.path)
    assert code == 2
    assert "Damaged shards were left alone" in out
    store.commit("shard-4", tables([10]))
    code, out = sweep("compact", "--store", store.path, "--json")
    found = json.loads(out)
    assert (code, found["shards_before"], found["shards_after"], found["trials"]) == (2, 3, 2, 5)
    assert [one["shard"] for one in found["damaged"]] == ["shard-1"]


def test_merge_says_what_was_brought(store, tmp_path):
    other = Store.create(tmp_path / "other")
    other.commit("b", tables([5, 6]))
    other.write_study("study", "", members_table("study", {"tune": [trial(0)]}))
    code, out = sweep("merge", other.path, "--store", store.path)
    assert (code, out) == (0, "1 trial brought; 1 was here already, with the same episodes.\nstudy brought: study\n")
    code, out = sweep("merge", other.path, "--store", tmp_path / "new", "--json")
    assert (code, json.loads(out)["trials"], json.loads(out)["studies"]) == (0, 2, ["study"])


def test_merge_reports_conflicts_with_what_they_were_trained(store, tmp_path):
    other = Store.create(tmp_path / "other")
    other.commit("b", tables([5], shift=1.0, host="elsewhere"))
    code, out = sweep("merge", other.path, "--store", store.path)
    assert code == 2
    row = next(line.split() for line in out.splitlines() if line.startswith(trial(5).id))
    assert (row[1:4], row[-2:]) == (["SAC", "Pendulum-CA", "5"], ["host", "elsewhere"])
    assert "1 trial with other episodes than here: the store's own rows were kept." in out
    code, out = sweep("merge", other.path, "--store", store.path, "--json")
    (conflict,) = json.loads(out)["conflicts"]
    assert (code, conflict["seed"], conflict["theirs"]["host"], conflict["store"]) == (2, 5, "elsewhere", str(other.path))
    assert len(rows(store.path, "trials")) == 6
