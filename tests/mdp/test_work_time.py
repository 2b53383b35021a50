"""Durations by the clock and of the processor."""

import time

import numpy as np

from mdp.machine_code import compile_timer, compiled
from mdp.work_time import WorkTime


def test_durations_add_up():
    assert WorkTime(3.0, 2.0) + WorkTime(1.0, 0.5) == WorkTime(4.0, 2.5)
    assert WorkTime(3.0, 2.0) - WorkTime(1.0, 0.5) == WorkTime(2.0, 1.5)
    assert WorkTime(1.23456, 0.00049).as_data() == {"seconds": 1.235, "cpu_seconds": 0.0}


def test_sleep_takes_no_processor():
    begun = WorkTime.now()
    time.sleep(0.2)
    slept = WorkTime.now() - begun
    assert slept.seconds >= 0.2
    assert slept.cpu_seconds < 0.1


def test_compiling_is_timed_as_a_whole():
    @compiled
    def inner(x):
        return x * np.pi + 1

    @compiled
    def outer(x):
        return inner(x) - np.pi

    begun = WorkTime.now()
    with compile_timer() as time_compiling:
        assert time_compiling() == WorkTime()
        outer(2.0)
        first = time_compiling()
        outer(3.0)
        assert time_compiling() == first
    taken = WorkTime.now() - begun
    assert 0 < first.seconds <= taken.seconds
    assert 0 < first.cpu_seconds <= taken.cpu_seconds
