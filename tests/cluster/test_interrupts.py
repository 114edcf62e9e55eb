"""What a Ctrl-C and a SIGTERM mean, and when."""

import os
import signal
import threading

import pytest

from cluster import interrupts
from cluster.interrupts import Interrupts


def press(number=signal.SIGINT):
    os.kill(os.getpid(), number)


@pytest.fixture
def told():
    """What workers are told."""
    return []


def test_once_drains_twice_stops_a_third_time_ends_it(told):
    asked = Interrupts(told.append)
    asked.working = True
    with asked.handled():
        press()
        assert (asked.draining, asked.stopping, told) == (True, False, ["drain"])
        asked.check()
        press()
        assert (asked.stopping, told) == (True, ["drain", "stop"])
        with pytest.raises(KeyboardInterrupt):
            press()


def test_a_batch_system_stops_at_once_and_may_say_so_twice(told):
    asked = Interrupts(told.append)
    asked.working = True
    with asked.handled():
        press(signal.SIGTERM)
        press(signal.SIGTERM)
        assert (asked.draining, asked.stopping, told) == (True, True, ["stop"])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_before_anything_has_begun_any_of_them_ends_it(told, number):
    asked = Interrupts(told.append)
    with asked.handled(), pytest.raises(KeyboardInterrupt):
        press(number)
    assert told == []


def test_workers_have_so_much_time_to_stop_and_no_more(told, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(interrupts.time, "monotonic", lambda: now[0])
    asked = Interrupts(told.append)
    asked.working = True
    with asked.handled():
        press(signal.SIGTERM)
    now[0] += interrupts.GRACE_SECONDS - 1
    asked.check()
    now[0] += 2
    with pytest.raises(KeyboardInterrupt):
        asked.check()


def test_handlers_are_put_back_and_other_threads_have_none(told):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with Interrupts(told.append).handled():
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] != before
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    entered = []

    def elsewhere():
        with Interrupts(told.append).handled():
            entered.append([signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before)

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert entered == [True]


def test_a_shell_that_wants_interrupts_ignored_has_its_way(told):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        asked = Interrupts(told.append)
        asked.working = True
        with asked.handled():
            press()
        assert not asked.draining
    finally:
        signal.signal(signal.SIGINT, before)
