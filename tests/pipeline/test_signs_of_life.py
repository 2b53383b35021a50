"""What is shown of something that takes long: on a terminal, and where only lines can be had."""

import io
import logging
import re
import threading
from types import SimpleNamespace

import pytest
from rich.console import Console

from pipeline import signs_of_life
from pipeline.signs_of_life import COMPILING, Heartbeat, Silence, can_move, doing


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands until it is told to go on."""
    fake = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(
        signs_of_life, "time", SimpleNamespace(monotonic=lambda: fake.now), raising=True
    )
    return fake


@pytest.fixture(autouse=True)
def hearts(monkeypatch):
    """Nothing beats by itself; which hearts do is noted."""
    beating = []

    class StillHeart(Heartbeat):
        def start(self):
            beating.append(self)

        def stop(self):
            beating.clear()

    monkeypatch.setattr(signs_of_life, "Heartbeat", StillHeart)
    return beating


def console_of(**options):
    file = io.StringIO()
    return file, Console(file=file, width=100, color_system=None, **options)


def plain(text):
    """Without the codes that move the cursor."""
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)


def compile_something():
    logging.getLogger("machine_code").info("compiling run_block")


# --- where lines stay ----------------------------------------------------------------------------


def test_what_is_over_soon_leaves_no_line(clock, hearts):
    file, console = console_of(force_terminal=False)
    with doing(console, "drawing") as activity:
        assert hearts
        clock.now += 5
        activity.look()
        activity.now("writing")
        activity.look()
    assert file.getvalue() == ""
    assert not hearts


def test_what_takes_long_is_said_after_five_seconds_and_then_every_ten(clock):
    file, console = console_of(force_terminal=False)
    said = []
    with doing(console, "drawing [all]") as activity:
        for second in range(1, 40):
            clock.now += 1
            activity.look()
            if len(file.getvalue().splitlines()) > len(said):
                said.append(second)
            if second == 20:
                activity.now("writing")
                activity.at("section 2 of 3")
    assert said == [6, 17, 28, 39]
    assert file.getvalue().splitlines() == [
        "drawing [all], 6 s",
        "drawing [all], 17 s",
        "writing: section 2 of 3, 8 s",
        "writing: section 2 of 3, 19 s",
    ]


def test_a_line_that_is_printed_meanwhile_breaks_the_silence(clock):
    file, console = console_of(force_terminal=False)
    with doing(console, "playing") as activity:
        for _ in range(9):
            clock.now += 4
            activity.say("episode [1]")
            activity.look()
    assert file.getvalue() == "episode [1]\n" * 9


def test_compiling_is_said_at_once_and_once(clock):
    file, console = console_of(force_terminal=False)
    with doing(console, "loading") as activity:
        compile_something()
        compile_something()
        clock.now += 9
        activity.look()
    compile_something()
    assert file.getvalue() == f"loading: {COMPILING}\n"


def test_a_quiet_console_gets_no_line_and_no_thread(clock, hearts):
    file, console = console_of(force_terminal=True, quiet=True)
    with doing(console, "loading") as activity:
        assert not hearts
        clock.now += 100
        activity.look()
        compile_something()
    assert file.getvalue() == ""


# --- on a terminal -------------------------------------------------------------------------------


def test_on_a_terminal_one_line_moves_and_is_gone_in_the_end(clock, hearts):
    file, console = console_of(force_terminal=True)
    with doing(console, "loading [x]") as activity:
        assert hearts
        # It is there at once, and does not wait for its heart.
        assert "loading [x]" in plain(file.getvalue())
        activity.at("2 of 3")
        activity.look()
        assert "loading [x]: 2 of 3" in plain(file.getvalue())
        compile_something()
        activity.look()
        assert f"loading [x]: {COMPILING}" in plain(file.getvalue())
        activity.say("a line")
    text = file.getvalue()
    assert "\na line" in plain(text).replace("\r", "\n")
    # The line was erased after it had been drawn for the last time, and the cursor is back.
    assert text.rindex("\x1b[2K") > text.rindex("loading")
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")
    assert not hearts


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ValueError])
def test_what_breaks_gives_the_terminal_back(clock, hearts, stop):
    file, console = console_of(force_terminal=True)

    def broken():
        with doing(console, "loading"):
            raise stop

    with pytest.raises(stop):
        broken()
    assert file.getvalue().rindex("\x1b[?25h") > file.getvalue().rindex("\x1b[?25l")
    assert not hearts
    compile_something()
    assert "compiling" not in file.getvalue()


@pytest.mark.parametrize(
    ("terminal", "term", "moves"),
    [(True, "xterm", True), (True, "dumb", False), (False, "", False)],
)
def test_a_line_moves_on_a_terminal_that_can(monkeypatch, terminal, term, moves):
    monkeypatch.setenv("TERM", term)
    assert can_move(Console(file=io.StringIO(), force_terminal=terminal)) is moves


# --- the heart -----------------------------------------------------------------------------------


def test_a_heart_beats_until_it_is_stopped_and_may_begin_again():
    beats = threading.Semaphore(0)
    heart = Heartbeat(beats.release, 0.001)
    for _ in range(2):
        heart.start()
        for _ in range(3):
            assert beats.acquire(timeout=30)
        heart.stop()
        heart.stop()
        while beats.acquire(blocking=False):
            pass
        assert not beats.acquire(timeout=0.02)


def test_a_heart_that_is_stopped_has_ended_its_last_call():
    begun, may_end, calls = threading.Event(), threading.Event(), []

    def call():
        begun.set()
        may_end.wait(30)
        calls.append(1)

    heart = Heartbeat(call, 0.001)
    heart.start()
    assert begun.wait(30)
    threading.Timer(0.05, may_end.set).start()
    heart.stop()
    assert calls == [1]


def test_a_heart_may_stop_itself():
    stopped = threading.Event()

    def call():
        heart.stop()
        stopped.set()

    heart = Heartbeat(call, 0.001)
    heart.start()
    assert stopped.wait(30)


def test_a_heart_that_cannot_write_stands_still_without_a_word(capfd):
    tried = threading.Semaphore(0)

    def fail():
        tried.release()
        raise OSError(28, "No space left on device")

    heart = Heartbeat(fail, 0.001)
    heart.start()
    assert tried.acquire(timeout=30)
    heart.stop()
    assert not tried.acquire(blocking=False)
    assert capfd.readouterr() == ("", "")


def test_silence_lasts_as_long_as_is_allowed_and_then_ten_seconds(clock):
    silence = Silence(2.0)
    clock.now += 2
    assert not silence.is_too_long
    clock.now += 0.1
    assert silence.is_too_long
    silence.end()
    clock.now += 10
    assert not silence.is_too_long
    clock.now += 0.1
    assert silence.is_too_long
