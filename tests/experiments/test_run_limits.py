"""Limits of time and memory: how they are written, and what a process takes."""

import contextlib
import mmap
import os
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments import run_limits
from experiments.run_limits import RunLimits, memory, resident_memory, seconds
from pipeline.errors import UserError


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("90", 90),
        ("90s", 90),
        ("0.5 s", 0.5),
        ("10m", 600),
        ("10min", 600),
        ("1.5h", 5400),
        ("2D", 172800),
    ],
)
def test_times(text, value):
    assert seconds(text) == value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("4GB", 4e9),
        ("4gb", 4e9),
        ("1.5 GB", 1.5e9),
        ("500MB", 5e8),
        ("4GiB", 2**32),
        ("5000000", 5e6),
    ],
)
def test_sizes(text, value):
    assert memory(text) == value
    assert isinstance(memory(text), int)


@pytest.mark.parametrize("read", [seconds, memory])
@pytest.mark.parametrize(
    "text",
    [
        "",
        "0",
        "-1",
        "nan",
        "inf",
        "1e3s",
        "10 parsecs",
        "m",
        "10m5",
        "\u0663m",
        "9" * 40,
        "4",
        "0GB",
    ],
)
def test_odd_ones(read, text):
    if (read, text) == (seconds, "4"):
        return
    with pytest.raises(ValueError, match=r"must be a (time|size)"):
        read(text)


@given(st.text())
def test_whatever_is_written_is_a_limit_or_refused(text):
    for read, most in ((seconds, 10**9), (memory, 10**18)):
        with contextlib.suppress(ValueError):
            assert 0 < read(text) <= most


def test_which_limit_is_exceeded():
    pid = os.getpid()
    assert RunLimits().pause is None
    assert RunLimits().exceeded(pid, 1e9) == ""
    assert RunLimits(seconds=5).exceeded(pid, 5) == ""
    assert "--run-timeout allows, 5 s" in RunLimits(seconds=5).exceeded(pid, 5.1)
    assert RunLimits(memory=10**15).exceeded(pid, 1e9) == ""
    words = RunLimits(memory=2 * 10**6).exceeded(pid, 3)
    assert "of memory after 3 s; --run-memory allows 2 MB" in words
    assert (
        RunLimits(seconds=5).pause == RunLimits(memory=2).pause == run_limits.SECONDS_BETWEEN_LOOKS
    )


def test_the_memory_that_a_process_takes():
    before = resident_memory(os.getpid())
    # Of the system: what Python asks for may be memory that this process has had before.
    with mmap.mmap(-1, 50_000_000) as kept:
        for start in range(0, len(kept), mmap.PAGESIZE):
            kept[start] = 1
        assert 45e6 < resident_memory(os.getpid()) - before < 60e6
    assert resident_memory(2**31 - 2) == 0


def test_where_there_is_no_proc_another_program_tells(monkeypatch):
    exists = run_limits.Path.exists
    monkeypatch.setattr(
        run_limits.Path, "exists", lambda path: "/proc/self" not in str(path) and exists(path)
    )

    def ps(command, **options):
        assert command == ["ps", "-o", "rss=", "-p", "7"]
        return run_limits.subprocess.CompletedProcess(command, 0, b" 1234\n")

    monkeypatch.setattr(run_limits.subprocess, "run", ps)
    assert resident_memory(7) == 1234 * 1024


def test_windows_refuses_what_it_cannot_measure(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    RunLimits(seconds=3)
    with pytest.raises(UserError, match="not measured on Windows"):
        RunLimits(memory=10**9)
