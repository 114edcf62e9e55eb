"""Records of what could not be trained: written, read again, and forgotten once it is."""

import json
import os
from datetime import UTC, datetime, timedelta

from small_shards import tables, trial

from sweep import failures
from sweep.failures import DAMAGED, KILLED, LOST, REASONS
from sweep.store import Store


def test_a_failure_is_read_as_it_was_recorded(tmp_path):
    store = Store.create(tmp_path)
    before = datetime.now(UTC) - timedelta(seconds=1)
    store.record_failure("shard", [trial(0), trial(1)], KILLED, "node-7", "Traceback …\nMemoryError: τ", attempts=3)
    (failure,) = store.failures()
    assert (failure.reason, failure.host, failure.attempts) == ("killed", "node-7", 3)
    assert failure.error == "Traceback …\nMemoryError: τ"
    assert before <= datetime.fromisoformat(failure.at) <= datetime.now(UTC)
    first = failure.trials[0]
    assert {
        name: first[name] for name in ("trial", "setting", "agent", "environment", "seed", "steps", "cutoff", "discount")
    } == {
        "trial": trial(0).id,
        "setting": trial(0).setting,
        "agent": "SAC",
        "environment": "Pendulum-CA",
        "seed": 0,
        "steps": 1000,
        "cutoff": 1000,
        "discount": 0.99,
    }
    assert (first["hidden_layers"], first["entropy_scale"]) == ([64, 64], 0.01)
    assert json.loads((tmp_path / "failures" / "shard.json").read_text())["format"] == 1


def test_trials_that_are_finished_by_now_have_not_failed(tmp_path):
    store = Store.create(tmp_path)
    store.record_failure("shard", [trial(0), trial(1)], "lost", "host", "gone")
    store.commit("other", tables([1]))
    assert [[known["trial"] for known in failure.trials] for failure in store.failures()] == [[trial(0).id]]
    assert (tmp_path / "failures" / "shard.json").exists()
    store.commit("another", tables([0]))
    assert store.failures() == []
    assert not (tmp_path / "failures" / "shard.json").exists()


def test_files_that_cannot_be_read_are_skipped_and_those_of_old_are_not(tmp_path):
    store = Store.create(tmp_path)
    store.record_failure("new", [trial(0)], "damaged", "host", "late")
    old = {"trials": [trial(1).id], "host": "node", "error": "boom"}
    (tmp_path / "failures" / "old.json").write_text(json.dumps(old))
    for number, content in enumerate(("", "[1]", '{"trials": 5}', '{"trials": [{}]}', '{"trials": [], "format": 1}', "\udcff")):
        (tmp_path / "failures" / f"bad-{number}.json").write_bytes(os.fsencode(content))
    oldest, newest = store.failures()
    assert (oldest.trials, oldest.reason, oldest.host, oldest.error) == (({"trial": trial(1).id},), "exception", "node", "boom")
    assert newest.reason == "damaged"
    store.commit("shard", tables([1]))
    assert not (tmp_path / "failures" / "old.json").exists()


def test_a_failure_that_cannot_be_written_down_is_no_error(tmp_path):
    store = Store.create(tmp_path)
    (tmp_path / "failures").write_text("in the way")
    store.record_failure("shard", [trial(0)], "lost", "host", "gone")
    assert store.failures() == []


def test_every_reason_has_a_sentence():
    assert set(REASONS) == {"exception", "memory", "killed", "lost", "store", "damaged"}
    assert REASONS[DAMAGED] == "The trial's files were damaged and put aside."
    assert all(sentence.endswith(".") for sentence in REASONS.values())


def test_a_record_is_parsed_once_and_again_only_when_it_has_changed(tmp_path, monkeypatch):
    store, parsed, parse = Store.create(tmp_path), [], failures._parse
    monkeypatch.setattr(failures, "_parse", lambda content: parsed.append(content["error"]) or parse(content))
    for number in range(3):
        store.record_failure(f"shard-{number}", [trial(number)], LOST, "host", f"error {number}")
    for number in range(5):
        store.commit(f"other-{number}", tables([10 + number]))
        assert [failure.error for failure in store.failures()] == ["error 0", "error 1", "error 2"]
    assert sorted(parsed) == ["error 0", "error 1", "error 2"]
    stat = (tmp_path / "failures" / "shard-1.json").stat()
    store.record_failure("shard-1", [trial(1)], LOST, "host", "error 9")  # as long as before, and just as old
    os.utime(tmp_path / "failures" / "shard-1.json", ns=(stat.st_atime_ns, stat.st_mtime_ns))
    (tmp_path / "failures" / "shard-2.json").unlink()
    assert [failure.error for failure in store.failures()] == ["error 0", "error 9"]
    assert parsed[3:] == ["error 9"]
    store.commit("last", tables([1]))
    assert [failure.error for failure in store.failures()] == ["error 0"]
    assert not (tmp_path / "failures" / "shard-1.json").exists()
