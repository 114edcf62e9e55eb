"""Heartbeats: which trials other launches train, whether these live, whatever their clocks say."""

import json
import os
import subprocess
import sys
import time

import pytest

from sweep import launches
from sweep.launches import Heartbeat, Neighbors, asked_to, clean_up, under_way


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test sets."""

    class Clock:
        now = 1000.0

    monkeypatch.setattr(launches.time, "monotonic", lambda: Clock.now)
    return Clock


def heart(store, trials, clock=None):
    beating = Heartbeat(store, "study")
    beating.beat(lambda: {"trials": trials}, now=True)
    return beating


def test_a_launch_sees_what_others_train_and_not_its_own(tmp_path):
    own, other = heart(tmp_path, ["a"]), heart(tmp_path, ["b", "c"])
    assert Neighbors(tmp_path, own.id).claimed() == {"b", "c"}
    assert Neighbors(tmp_path, other.id).claimed() == {"a"}
    other.end()
    assert Neighbors(tmp_path, own.id).claimed() == set()
    assert [one["launch"] for one in under_way(tmp_path)] == [own.id]


def test_a_heart_that_stands_still_for_a_minute_is_dead_and_comes_to_life_when_it_beats(tmp_path, clock):
    other = heart(tmp_path, ["b"])
    seen = Neighbors(tmp_path, "own")
    assert seen.claimed() == {"b"}
    clock.now += 59
    assert seen.claimed() == {"b"}
    clock.now += 2
    assert seen.claimed() == set()
    other.beat(lambda: {"trials": ["b"]})
    assert seen.claimed() == {"b"}


@pytest.mark.parametrize("jump", [-86_400, 86_400])
def test_clocks_that_jump_make_no_launch_dead_for_its_neighbors(tmp_path, monkeypatch, jump):
    before = time.time
    monkeypatch.setattr(launches.time, "time", lambda: before() + jump)
    heart(tmp_path, ["b"])
    monkeypatch.undo()
    assert Neighbors(tmp_path, "own").claimed() == {"b"}


def test_a_launch_whose_process_is_gone_claims_nothing(tmp_path):
    code = (
        "import sys; from pathlib import Path; from sweep.launches import Heartbeat\n"
        "Heartbeat(Path(sys.argv[1]), 'study').beat(lambda: {'trials': ['b']}, now=True)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    (file,) = (tmp_path / ".launches").iterdir()
    assert Neighbors(tmp_path, "own").claimed() == set()
    assert under_way(tmp_path) == []
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"host": "elsewhere"}))  # there, nobody here can know
    assert Neighbors(tmp_path, "own").claimed() == {"b"}


def test_what_cannot_be_read_is_passed_over(tmp_path):
    heart(tmp_path, ["b"])
    for name, content in (("broken", b"{"), ("list", b"[]"), ("bytes", b"\xff\xfe"), ("empty", b"")):
        (tmp_path / ".launches" / f"{name}.json").write_bytes(content)
    assert Neighbors(tmp_path, "own").claimed() == {"b"}
    assert len(under_way(tmp_path)) == 1


def test_beats_are_seconds_apart_unless_asked_for_now(tmp_path, clock):
    news = []
    beating = Heartbeat(tmp_path, "study")
    for wait in (0, 1, 1.5, 0.1):
        clock.now += wait
        beating.beat(lambda: news.append(clock.now) or {})
    assert news == [1000.0, 1002.5]
    beating.beat(lambda: news.append(clock.now) or {}, now=True)
    assert len(news) == 3


def test_workers_are_told_and_the_notes_go_with_the_launch(tmp_path):
    beating = heart(tmp_path, [])
    assert not asked_to(tmp_path, beating.id, "stop")
    beating.ask_workers_to("drain")
    assert asked_to(tmp_path, beating.id, "drain") and not asked_to(tmp_path, beating.id, "stop")
    assert not asked_to(tmp_path, "", "drain")
    beating.ask_workers_to("stop")
    beating.end()
    assert list((tmp_path / ".launches").iterdir()) == []


def test_a_folder_that_takes_no_heartbeat_stops_no_launch(tmp_path):
    (tmp_path / ".launches").write_text("in the way")
    beating = heart(tmp_path, ["a"])
    beating.ask_workers_to("stop")
    beating.end()


def test_what_dead_launches_left_goes_after_a_day(tmp_path):
    old, young = heart(tmp_path, []), heart(tmp_path, [])
    (file,) = (tmp_path / ".launches").glob(f"{old.id}.json")
    os.utime(file, (time.time() - 25 * 3600,) * 2)
    clean_up(tmp_path)
    assert [file.stem for file in (tmp_path / ".launches").iterdir()] == [young.id]
