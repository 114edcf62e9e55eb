"""Merging: what other stores have, brought once; what differs, reported."""

import contextlib
import errno
import os
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from faults import Faults, Killed
from small_shards import rows, tables, trial

from sweep import schema
from sweep.compaction import compact
from sweep.files import UnwritableError
from sweep.merging import merge
from sweep.messages import UserError
from sweep.store import Store
from sweep.tables import members_table
from sweep.verification import verify


@pytest.fixture
def store(tmp_path):
    made = Store.create(tmp_path / "here")
    made.commit("a", tables([0, 1]))
    return made


@pytest.fixture
def other(tmp_path):
    return Store.create(tmp_path / "other")


def selection(basis="b" * 16, hypers="{}", at=0):
    row = dict.fromkeys(schema.SELECTIONS.names) | {"by": "per-environment", "agent": "SAC", "environment": "Pendulum-CA"}
    row |= {"for_each": "{}", "hypers": hypers, "basis": basis, "selected_at": at}
    return pa.Table.from_pylist([row], schema.SELECTIONS)


def choose(store, study, chosen):
    pq.write_table(chosen, store.path / "studies" / study / "selections.parquet")


def seeds(store):
    return sorted(row["seed"] for row in rows(store.path, "trials"))


def test_shards_of_new_trials_are_copied_byte_for_byte(store, other):
    other.commit("b", tables([2, 3], evaluated=True))
    report = merge(store, [other])
    assert (report.trials, report.same, report.conflicts) == (2, 0, [])
    assert seeds(store) == [0, 1, 2, 3]
    theirs, ours = (known.path / "shards" / "b" for known in (other, store))
    assert {file.name: file.read_bytes() for file in ours.iterdir()} == {
        file.name: file.read_bytes() for file in theirs.iterdir()
    }
    assert verify(store).problems == ()


def test_of_a_shard_with_trials_that_are_here_the_rest_is_brought(store, other):
    other.commit("b", tables([1, 2]))
    before = rows(store.path, "steps")
    report = merge(store, [other])
    assert (report.trials, report.same, report.conflicts) == (1, 1, [])
    assert seeds(store) == [0, 1, 2]
    assert [row for row in rows(store.path, "steps") if row["trial"] != trial(2).id] == before
    assert verify(store).problems == ()


def test_merging_again_brings_nothing_and_several_stores_may_overlap(store, other, tmp_path):
    third = Store.create(tmp_path / "third")
    other.commit("b", tables([2, 3]))
    third.commit("c", tables([3, 4]))
    third.commit("d", tables([0]))
    assert (merge(store, [other, third]).trials, seeds(store)) == (3, [0, 1, 2, 3, 4])
    report = merge(store, [third, other])
    assert (report.trials, report.same, report.conflicts) == (0, 5, [])
    assert verify(store).problems == ()


def test_a_trial_with_other_episodes_is_a_conflict_and_the_stores_own_row_stays(store, other):
    other.commit("b", tables([1, 2], host="elsewhere", shift=0.5))
    before = [row for row in rows(store.path, "trials") if row["seed"] == 1]
    report = merge(store, [other])
    assert (report.trials, report.same) == (1, 0)
    (conflict,) = report.conflicts
    assert (conflict.trial, conflict.agent, conflict.environment, conflict.seed) == (trial(1).id, "SAC", "Pendulum-CA", 1)
    assert (conflict.ours["host"], conflict.theirs["host"], conflict.ours["engine"]) == ("host", "elsewhere", "torch")
    assert conflict.store == other.path
    assert [row for row in rows(store.path, "trials") if row["seed"] == 1] == before
    assert seeds(store) == [0, 1, 2]


def test_other_evaluation_episodes_are_a_conflict_and_another_host_is_none(tmp_path, store, other):
    evaluated = tables([5], evaluated=True)
    store.commit("c", evaluated)
    changed = evaluated.evaluations.set_column(4, "episodic_return", pa.array([5.0, 5.0, 5.0, 6.0], pa.float32()))
    other.commit("c", type(evaluated)(evaluated.trials, evaluated.episodes, changed))
    other.commit("a", tables([0, 1], host="elsewhere"))
    report = merge(store, [other])
    assert [conflict.seed for conflict in report.conflicts] == [5]
    assert report.same == 2


def test_a_compacted_store_is_merged_and_replaces_nothing_here(store, other):
    """The other store is a copy of this one that was compacted: its shards carry the names of this one's."""
    other.commit("a", tables([7]))
    other.commit("b", tables([8]))
    compact(other)
    assert merge(store, [other]).trials == 2
    assert seeds(store) == [0, 1, 7, 8]
    assert len(store.finished_trials()) == 4
    assert verify(store).problems == ()


def test_studies_and_selections_are_brought_compared_and_never_overwritten(store, other):
    needed = {"tune": [trial(0), trial(1)]}
    for study in ("missing", "same", "unselected", "reselected"):
        other.write_study(study, "grid", members_table(study, needed), ["a=1"])
        choose(other, study, selection(at=5))
        if study != "missing":
            store.write_study(study, "grid of mine", members_table(study, needed))
    choose(store, "same", selection(at=6))
    choose(store, "reselected", selection(hypers='{"a": 1}'))
    store.write_study("different", "grid", members_table("different", needed))
    other.write_study("different", "grid", members_table("different", {"tune": [trial(0), trial(2)]}))
    for _ in range(2):
        report = merge(store, [other])
        assert [sentence.split()[1] for sentence in report.study_conflicts] == ["different", "reselected"]
        assert "has other trials" in report.study_conflicts[0] and "has another selection" in report.study_conflicts[1]
    assert store.study_source("missing") == ("grid", ("a=1",))
    assert store.study_trials("missing") == {trial(0).id, trial(1).id}
    assert store.study_source("same")[0] == "grid of mine"
    assert store.study_trials("different", "evaluate") == set()
    for study in ("missing", "unselected"):
        files = [known.path / "studies" / study / "selections.parquet" for known in (store, other)]
        assert files[0].read_bytes() == files[1].read_bytes()


def test_of_a_study_that_is_further_along_in_one_store_that_one_is_taken(store, other):
    needed = {"tune": [trial(0), trial(1)]}
    further = {**needed, "evaluate": [trial(2)]}
    for name, mine, theirs in (("behind", needed, further), ("ahead", further, needed)):
        store.write_study(name, "grid", members_table(name, mine))
        other.write_study(name, "grid", members_table(name, theirs))
    choose(other, "behind", selection(at=5))
    report = merge(store, [other])
    assert (report.study_conflicts, report.studies) == ([], ["behind"])
    for name in ("behind", "ahead"):
        assert store.study_trials(name, "evaluate") == {trial(2).id}
    assert (store.path / "studies" / "behind" / "selections.parquet").exists()


def test_a_study_that_is_taken_is_wholly_theirs(store, other):
    store.write_study("study", "mine", members_table("study", {"tune": [trial(0)]}), ["a=1"])
    choose(store, "study", selection())
    other.write_study("study", "theirs", members_table("study", {"tune": [trial(0), trial(1)]}))
    merge(store, [other])
    theirs, ours = (
        {file.name: file.read_bytes() for file in (known.path / "studies" / "study").iterdir()} for known in (other, store)
    )
    assert ours == theirs and sorted(ours) == ["grid.toml", "members.parquet"]
    assert store.study_source("study") == ("theirs", ())


def test_a_study_that_is_taken_counts_as_ours_only_when_all_of_it_is_here(store, other, monkeypatch):
    store.write_study("study", "mine", members_table("study", {"tune": [trial(0)]}), ["a=1"])
    other.write_study("study", "theirs", members_table("study", {"tune": [trial(0), trial(1)]}))
    unlink = os.unlink

    def refuse(path, *rest, **options):
        if os.fspath(path).endswith("overrides.json"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        unlink(path, *rest, **options)

    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", refuse)
        with pytest.raises(UnwritableError, match="study: cannot be written to: Input/output error"):
            merge(store, [other])
    assert store.study_trials("study") == {trial(0).id}
    assert merge(store, [other]).studies == ["study"]
    assert store.study_source("study") == ("theirs", ())


def test_failures_are_not_brought(store, other):
    other.record_failure("c", [trial(9)], "lost", "host", "gone")
    merge(store, [other])
    assert store.failures() == []


@pytest.mark.parametrize("name", ["trials.parquet", "episodes.parquet", "steps.parquet", "manifest.json"])
def test_a_damaged_store_is_refused_before_anything_is_written(store, other, name):
    other.commit("b", tables([2]))
    other.commit("c", tables([3]))
    file = other.path / "shards" / "c" / name
    file.write_bytes(file.read_bytes()[:-10] + b"0123456789")
    with pytest.raises(UserError, match=f"c/{name}: is damaged: .*sweep verify --store .*other` says what else is"):
        merge(store, [other])
    assert seeds(store) == [0, 1]


def test_a_store_is_not_merged_with_itself(store, other, tmp_path):
    (tmp_path / "link").symlink_to(store.path)
    for others in ([Store(tmp_path / "link")], [other, other]):
        with pytest.raises(UserError, match="cannot be merged with itself"):
            merge(store, others)


@pytest.mark.parametrize(
    ("error", "stride"),
    [
        pytest.param(errno.ENOSPC, 37, id="some calls, full"),
        pytest.param(None, 31, id="some calls, killed"),
        pytest.param(errno.ENOSPC, 1, id="full", marks=pytest.mark.slow),
        pytest.param(None, 1, id="killed", marks=pytest.mark.slow),
    ],
)
def test_whichever_call_of_a_merge_fails_it_can_be_repeated(tmp_path, store, other, error, stride):
    other.commit("b", tables([1, 2]))
    other.commit("c", tables([3]))
    other.write_study("study", "grid", members_table("study", {"tune": [trial(0)]}), ["a=1"])
    choose(other, "study", selection())
    at, faults = 1, None
    while faults is None or faults.happened:
        here = Store.open(shutil.copytree(store.path, tmp_path / str(at)))
        faults = Faults(here.path, at, error)
        with faults.installed(), contextlib.suppress(UnwritableError, Killed):
            merge(here, [other])
        assert verify(Store.open(here.path)).problems == ()
        report = merge(Store.open(here.path), [other])
        assert (report.conflicts, report.study_conflicts) == ([], [])
        assert seeds(here) == [0, 1, 2, 3]
        assert here.study_source("study") == ("grid", ("a=1",))
        assert (here.path / "studies" / "study" / "selections.parquet").exists()
        assert verify(here).problems == ()
        at += stride


def test_a_store_that_was_compacted_meanwhile_is_said_to_be(store, other, monkeypatch):
    other.commit("b", tables([2]))

    def gone(self, shard, source, with_steps):
        raise FileNotFoundError(2, "No such file or directory", str(Path("shards") / shard))

    monkeypatch.setattr(Store, "commit_copy", gone)
    with pytest.raises(UserError, match="shards/b: is gone: the store was compacted meanwhile; merge again"):
        merge(store, [other])


def test_a_file_that_is_damaged_after_it_was_checked_is_not_brought(store, other):
    other.commit("b", tables([2]))
    folder = other.path / "shards" / "b"
    content = (folder / "steps.parquet").read_bytes()
    (folder / "steps.parquet").write_bytes(content[:100] + bytes([content[100] ^ 1]) + content[101:])
    with pytest.raises(UserError, match=r"b/steps.parquet: is damaged: its content is not what was written"):
        store.commit_copy("b", folder)
    (folder / "steps.parquet").unlink()
    with pytest.raises(UserError, match=r"b/steps.parquet: is damaged: it is missing"):
        store.commit_copy("b", folder)
    assert seeds(store) == [0, 1]
    assert not list(store.path.glob(".staging/*"))


def test_without_steps_everything_but_the_spelled_out_episodes_is_brought(store, other):
    other.commit("b", tables([2, 3], evaluated=True))
    other.commit("c", tables([1, 4]))  # seed 1 is here already: the rest is written anew
    merge(store, [other], with_steps=False)
    assert seeds(store) == [0, 1, 2, 3, 4]
    shards = {folder.name: {file.name for file in folder.glob("*.parquet")} for folder in store.shards()}
    tables_of_all = {"trials.parquet", "episodes.parquet"}
    assert shards == {"a": tables_of_all | {"steps.parquet"}, "b": tables_of_all | {"evaluations.parquet"}, "c": tables_of_all}
    assert verify(store).problems == ()
    assert {row["trial"] for row in rows(store.path, "steps")} == {trial(0).id, trial(1).id}


def test_a_file_of_steps_that_nobody_wrote_is_a_problem(store, other):
    other.commit("b", tables([2, 3]))
    merge(store, [other], with_steps=False)
    shutil.copy(other.path / "shards" / "b" / "steps.parquet", store.path / "shards" / "b")
    assert [problem.what for problem in verify(store).problems] == ["the manifest does not name it"]


def test_compaction_spells_the_episodes_out_again(store, other, tmp_path):
    other.commit("b", tables([2, 3]))
    other.commit("c", tables([4, 5]))
    small = Store.create(tmp_path / "small")
    merge(small, [other], with_steps=False)
    compact(small)
    assert verify(small).problems == ()
    spelled_out = [sorted(map(str, rows(known.path, "steps"))) for known in (small, other)]
    assert spelled_out[0] == spelled_out[1]
