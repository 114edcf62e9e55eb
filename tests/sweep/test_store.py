"""The store: every trial exactly once, whoever commits it."""

import multiprocessing
import threading

import pytest
from small_shards import rows, tables, trial

from sweep.messages import UserError
from sweep.store import Store
from sweep.verification import verify


def test_what_is_committed_can_be_read_back_and_is_finished(tmp_path):
    store = Store.create(tmp_path / "store")
    committed = tables([0, 1])
    assert store.commit("shard-1", committed) == 2
    assert store.finished_trials() == set(committed.trials["trial"].to_pylist())
    assert rows(store.path, "episodes") == committed.episodes.to_pylist()
    assert rows(store.path, "steps") == [row for block in committed.steps_in_blocks(100) for row in block.to_pylist()]
    assert [row["trial"] for row in rows(store.path, "trials")] == committed.trials["trial"].to_pylist()
    assert not list((tmp_path / "store" / ".staging").iterdir())


def test_a_trial_is_never_there_twice_whichever_shard_it_comes_with(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard-1", tables([0, 1]))
    assert store.commit("shard-1", tables([0, 1])) == 0
    assert store.commit("shard-2", tables([1, 2])) == 1
    assert sorted(row["seed"] for row in rows(store.path, "trials")) == [0, 1, 2]
    assert len(rows(store.path, "steps")) == 3000


def _commit(arguments):
    path, shard, seeds = arguments
    return Store(path).commit(shard, tables(seeds))


def test_four_processes_that_commit_overlapping_shards_leave_each_trial_exactly_once(tmp_path):
    Store.create(tmp_path)
    work = [(tmp_path, f"shard-{i % 50}", [i % 50, (i + 7) % 50]) for i in range(200)]
    with multiprocessing.get_context("spawn").Pool(4) as pool:
        new = pool.map(_commit, work, chunksize=1)
    assert sum(new) == 50
    assert sorted(row["seed"] for row in rows(tmp_path, "trials")) == list(range(50))
    assert len(rows(tmp_path, "steps")) == 50_000
    report = verify(Store(tmp_path))
    assert (report.problems, report.trials) == ((), 50)


def test_a_commit_waits_for_another_one_to_end(tmp_path):
    store = Store.create(tmp_path)
    waiting = threading.Thread(target=Store.open(tmp_path).commit, args=("shard", tables([0])))
    with store.locked():
        waiting.start()
        waiting.join(0.5)
        assert waiting.is_alive() and store.finished_trials() == set()
    waiting.join()
    assert store.finished_trials() == {trial(0).id}


def test_a_store_from_before_there_were_manifests_is_read(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard", tables([0]))
    (tmp_path / "shards" / "shard" / "manifest.json").unlink()
    assert Store.open(tmp_path).finished_trials() == {trial(0).id}
    assert Store.open(tmp_path).commit("other", tables([0, 1])) == 1


def test_the_rest_of_a_shard_comes_after_its_first_part_under_a_name_of_its_own(tmp_path):
    """A worker given up for dead commits the whole of a shard, of which another one had only the last trial to commit."""
    store = Store.create(tmp_path)
    store.commit("shard", tables([0]))
    assert store.commit("shard", tables([0, 1])) == 1
    assert [folder.name[:6] for folder in store.shards()] == ["shard", "shard-"]
    assert store.finished_trials() == {trial(0).id, trial(1).id}


def test_a_shard_put_aside_is_missing_and_can_be_committed_again(tmp_path):
    store = Store.create(tmp_path)
    store.commit("shard", tables([0]))
    store.commit("other", tables([1]))
    assert store.finished_trials() == {trial(0).id, trial(1).id}
    target = store.quarantine("shard")
    assert target.parent == tmp_path / ".quarantine" and (target / "trials.parquet").exists()
    assert store.finished_trials() == {trial(1).id}
    assert store.commit("shard", tables([0, 2])) == 2
    assert store.finished_trials() == {trial(seed).id for seed in (0, 1, 2)}
    assert store.quarantine("shard") != target
    for name in ("shard", "../studies", ".", "..", "", "other/.."):
        with pytest.raises(UserError, match="there is no shard"):
            store.quarantine(name)


def test_nothing_but_a_shard_is_removed(tmp_path):
    store = Store.create(tmp_path / "store")
    store.commit("shard", tables([0]))
    (tmp_path / "precious").mkdir()
    shards = store.path / "shards"
    for folder in (tmp_path / "precious", shards / "../../precious", shards / "..", shards, shards / "shard" / "..", store.path):
        with pytest.raises(ValueError, match="is no shard of"):
            store.discard([folder])
        assert (tmp_path / "precious").exists() and store.finished_trials() == {trial(0).id}
    store.discard([shards / "shard"])
    assert store.shards() == []


def test_a_store_is_opened_if_there_is_one(tmp_path):
    assert Store.open_if_any(tmp_path / "missing") is None
    assert Store.open_if_any(tmp_path) is None
    Store.create(tmp_path)
    assert Store.open_if_any(tmp_path).path == tmp_path
    (tmp_path / "sweep-store.json").unlink()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(UserError, match="is not a store"):
        Store.open_if_any(tmp_path)


def test_a_folder_that_is_not_a_store_is_refused_and_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for refuse in (Store.open, Store.create):
        with pytest.raises(UserError, match=r"is not a store: it has no readable sweep-store.json"):
            refuse(tmp_path)
    with pytest.raises(UserError, match="is not a store"):
        Store.create(tmp_path / "notes.txt")
    with pytest.raises(UserError, match="there is no store here"):
        Store.open(tmp_path / "missing")
    assert [file.name for file in tmp_path.iterdir()] == ["notes.txt"]


def test_a_store_of_another_format_is_refused(tmp_path):
    (tmp_path / "sweep-store.json").write_text('{"format": 99}')
    with pytest.raises(UserError, match="another format"):
        Store.open(tmp_path)
