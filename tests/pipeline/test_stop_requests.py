"""What asks a process to stop is held, waits, and is not forgotten."""

import ctypes
import os
import pickle
import signal
import threading
import time
from contextlib import suppress

import pytest

from pipeline import stopping
from pipeline.stopping import SIGNALS, Stopped, current, stops_noticed

LONG = 30.0  # seconds: nothing here waits so long


@pytest.fixture(autouse=True)
def handlers_are_as_before():
    """And by default, whatever the tests were started under."""
    by_default = [
        signal.default_int_handler if n == signal.SIGINT else signal.SIG_DFL for n in SIGNALS
    ]
    before = [signal.signal(*pair) for pair in zip(SIGNALS, by_default, strict=True)]
    yield
    after = [signal.signal(*pair) for pair in zip(SIGNALS, before, strict=True)]
    assert after == by_default
    assert current().number is None


def stopped(work):
    """What a stop was called, and the number of seconds until it was raised."""
    started = time.monotonic()
    with pytest.raises(Stopped) as caught:
        work()
    return str(caught.value), time.monotonic() - started


def send(number=signal.SIGTERM):
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_stops_at_once(number):
    with stops_noticed() as stop:
        assert stopped(lambda: send(number))[0] == signal.Signals(number).name
        assert (stop.number, current()) == (number, stop)


def test_what_is_held_is_told_at_the_next_safe_moment():
    with stops_noticed() as stop, stop.held():
        send()
        stopped(stop.raise_if_asked)


def test_waiting_ends_when_its_time_is_over_also_in_the_midst_of_a_wait():
    def work():
        with stop.held(), stop.waiting(0.3):
            send()
            threading.Event().wait(LONG)

    with stops_noticed() as stop:
        assert 0.3 <= stopped(work)[1] < LONG


def test_a_second_signal_waits_for_nothing_but_what_is_held(monkeypatch):
    monkeypatch.setattr(stopping, "SECONDS_OF_ONE_REQUEST", 0.0)

    def work():
        with stop.waiting(LONG):
            send()
            with stop.held():
                send()
            assert stop.is_urgent
            time.sleep(LONG)

    with stops_noticed() as stop:
        assert stopped(work)[1] < LONG


def test_a_key_that_is_held_down_asks_once():
    with stops_noticed() as stop, stop.held():
        for _ in range(100):
            send(signal.SIGINT)
        assert stop.n_asked == 1


def test_work_that_has_no_time_left_is_not_begun():
    def work():
        with stop.waiting(0.0):
            done.append("something")

    done = []
    with stops_noticed() as stop, stop.held():
        send()
        stopped(work)
    assert done == []


def test_what_swallows_a_stop_is_told_again():
    def work():
        with stop.waiting(0.0):
            with suppress(BaseException):  # as a bare except in a user's environment
                send()
            time.sleep(LONG)

    with stops_noticed() as stop:
        assert stopped(work)[1] < LONG


def test_a_failure_that_comes_of_a_swallowed_stop_is_a_stop(capsys):
    """In Numba's compiler it is raised where C code has called Python, and is lost there."""

    def work():
        with stop.waiting(0.0):
            ctypes.CFUNCTYPE(None)(send)()
            raise RuntimeError("no compiled object yet")

    with stops_noticed() as stop:
        stopped(work)
    assert capsys.readouterr().err == ""


def test_what_a_library_made_of_a_stop_is_a_stop():
    def work(error):
        with stop.waiting(0.0):
            try:
                send()
            except KeyboardInterrupt as stopped:
                raise error from stopped

    with stops_noticed() as stop:
        assert stopped(lambda: work(ImportError("no module")))[0] == "SIGTERM"
        with pytest.raises(ValueError, match="its own"), stop.waiting(LONG):
            raise ValueError("its own")


def test_in_a_thread_and_inside_another_there_is_nothing_new():
    def work():
        with stops_noticed() as inner:
            seen.append((inner.number, inner is outer, current() is outer))

    seen = []
    with stops_noticed() as outer, outer.held():
        send()
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        work()
    assert seen == [(None, False, False), (signal.SIGTERM, True, True)]


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda *_: None])
def test_what_is_ignored_or_handled_already_stays_so(handler):
    previous = signal.signal(signal.SIGHUP, handler)
    try:
        with stops_noticed() as stop:
            send(signal.SIGHUP)
            assert stop.number is None
    finally:
        signal.signal(signal.SIGHUP, previous)


def test_a_stop_can_be_handed_to_another_process():
    assert pickle.loads(pickle.dumps(Stopped(signal.SIGHUP))).number == signal.SIGHUP
