"""Schedules in closed form, and the same to the last bit as rows of four numbers."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from agents.common.schedules import (
    EXPONENTIAL,
    LINEAR,
    ExponentialSchedule,
    schedule_row,
    schedule_value,
)

# Training may run past its end, by a rollout or an episode.
progress = st.floats(-0.5, 1)
values = st.floats(-1e6, 1e6)
positive = st.floats(1e-9, 1e9)
shares = st.floats(1e-3, 1)

linear = st.builds(LinearSchedule, values, values, shares)
exponential = st.builds(ExponentialSchedule, positive, positive, shares)
constant = st.builds(ConstantSchedule, values)
schedules = st.one_of(
    linear,
    exponential,
    constant,
    st.builds(FloatSchedule, values | st.integers(-9, 9) | linear | exponential | constant),
)


@given(schedules, st.lists(progress, min_size=20, max_size=20))
def test_a_row_gives_what_the_schedule_gives_bit_for_bit(schedule, points):
    row = schedule_row(schedule)
    # Of one type, so that compiled code takes them all.
    assert [type(number) for number in row] == [float] * 4
    for point in [*points, 0.0, 0.5, 1.0]:
        assert schedule_value(row, point) == schedule(point)


@given(values | st.integers(-9, 9), progress)
def test_a_number_is_constant(number, point):
    assert schedule_value(schedule_row(number), point) == number


def test_every_step_of_a_run_bit_for_bit():
    schedule = LinearSchedule(1.0, 0.05, 0.37)
    row = schedule_row(schedule)
    points = [1.0 - step / 30_011 for step in range(30_011 + 1)]
    assert [schedule_value(row, point) for point in points] == list(map(schedule, points))


@pytest.mark.parametrize(
    ("schedule", "row"),
    [
        (ExponentialSchedule(0.5, 0.25, 0.75), (EXPONENTIAL, 0.5, 0.25, 0.75)),
        (LinearSchedule(1, 0, 0.5), (LINEAR, 1, 0, 0.5)),
        (FloatSchedule(FloatSchedule(LinearSchedule(1, 0, 0.5))), (LINEAR, 1, 0, 0.5)),
        (ConstantSchedule(3), (LINEAR, 3, 3, 1)),
        (0.1, (LINEAR, 0.1, 0.1, 1)),
    ],
)
def test_rows(schedule, row):
    assert schedule_row(schedule) == row


@pytest.mark.parametrize(
    "schedule", [lambda point: point, FloatSchedule(lambda point: point), "lin_0.1"]
)
def test_a_foreign_function_has_no_row(schedule):
    assert schedule_row(schedule) is None


@pytest.mark.parametrize(
    ("point", "value"),
    # From 16 to 1 over the first half: a factor of 2 for each eighth of the training.
    [(1.0, 16), (0.875, 8), (0.75, 4), (0.625, 2), (0.5, 1), (0.25, 1), (0.0, 1), (-0.1, 1)],
)
def test_exponential_decay_worked_by_hand(point, value):
    assert ExponentialSchedule(16.0, 1.0, 0.5)(point) == pytest.approx(value, rel=1e-14)


@given(positive, positive, shares, st.floats(0, 1))
def test_exponential_decay_in_closed_form(start, end, end_fraction, point):
    elapsed = min((1.0 - point) / end_fraction, 1.0)
    expected = math.exp((1.0 - elapsed) * math.log(start) + elapsed * math.log(end))
    value = ExponentialSchedule(start, end, end_fraction)(point)
    assert value == pytest.approx(expected, rel=1e-12)
    assert type(value) is float


def test_the_end_of_a_decay_is_exact():
    schedule = ExponentialSchedule(0.7, 0.003, 0.6)
    assert schedule(1.0) == 0.7
    assert schedule(0.399) == schedule(0.0) == 0.003


@pytest.mark.parametrize("start", [0.0, -1.0, math.nan])
@pytest.mark.parametrize("swap", [False, True])
def test_a_decay_from_or_to_nothing_is_refused(start, swap):
    ends = (1.0, start) if swap else (start, 1.0)
    with pytest.raises(ValueError, match=f"start and end above 0, not {ends[0]} and {ends[1]}"):
        ExponentialSchedule(*ends)


@pytest.mark.parametrize("share", [0.0, -0.5, 1.0000001, math.nan])
def test_a_share_outside_of_training_is_refused(share):
    with pytest.raises(ValueError, match=r"end_fraction must lie in \(0, 1\], not "):
        ExponentialSchedule(1.0, 0.5, share)


def test_its_text_makes_it_again():
    schedule = ExponentialSchedule(1.0, 0.5, 0.25)
    assert repr(schedule) == "ExponentialSchedule(start=1.0, end=0.5, end_fraction=0.25)"
