"""Schedules of a number over training, beside those of Stable-Baselines3.

A schedule maps ``progress_remaining``, which falls from 1 at the first step to 0 at the last, to a
value. `schedule_row` writes a known schedule as four numbers, so that compiled code can evaluate
it. `schedule_value` evaluates these four numbers, and is the only place with the arithmetic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from torch.distributions.transforms import AffineTransform, ComposeTransform, ExpTransform

from rl_yardstick.machine_code.compiling import inlined

LINEAR = 0.0
EXPONENTIAL = 1.0


class ScheduleRow(NamedTuple):
    """A schedule as four numbers; records of compiled code store the same four."""

    kind: float  # `LINEAR` or `EXPONENTIAL`
    start: float  # the value at the first step
    end: float  # the value from ``end_fraction`` on
    end_fraction: float  # the share of training after which the value is ``end``


@inlined
def schedule_value(schedule: ScheduleRow, progress_remaining: float) -> float:
    """The value of a schedule at ``progress_remaining``, which falls from 1 to 0."""
    elapsed = 1.0 - progress_remaining
    if elapsed > schedule.end_fraction:
        return schedule.end
    if schedule.kind == LINEAR:
        if schedule.start == schedule.end:  # saves a division at every step
            return schedule.start
        change = elapsed * (schedule.end - schedule.start)
        return schedule.start + change / schedule.end_fraction
    rate = math.log(schedule.end / schedule.start)
    return schedule.start * math.exp(rate * elapsed / schedule.end_fraction)


@dataclass(eq=False)
class ExponentialSchedule:
    """Decay from ``start`` to ``end`` by a constant factor per step.

    Args:
        start: the value at the first step, above 0.
        end: the value from ``end_fraction`` on, above 0.
        end_fraction: the share of training after which the value is ``end``, in (0, 1].

    Raises:
        ValueError: if a value lies outside its range.
    """

    start: float
    end: float
    end_fraction: float = 1.0

    def __post_init__(self) -> None:
        if not (self.start > 0 and self.end > 0):
            given = f"{self.start} and {self.end}"
            raise ValueError(f"an exponential schedule needs start and end above 0, not {given}")
        if not 0 < self.end_fraction <= 1:
            raise ValueError(f"end_fraction must lie in (0, 1], not {self.end_fraction}")

    def __call__(self, progress_remaining: float) -> float:
        return schedule_value(_row(EXPONENTIAL, self), progress_remaining)


def library_schedule(schedule: ExponentialSchedule) -> Schedule:
    """The schedule from PyTorch classes: exp(log(end) + log(start / end) * remaining).

    A library agent's zip pickles its schedules by the names of their classes. PyTorch is installed
    wherever that agent runs, but a class of ours would need this project.
    """
    assert schedule.end_fraction == 1
    log_end = th.tensor(math.log(schedule.end), dtype=th.float64)
    fall = AffineTransform(log_end, math.log(schedule.start / schedule.end))
    transform: Schedule = ComposeTransform([fall, ExpTransform()])
    return transform


def epsilon_schedule(agent: Any) -> Schedule:
    """The schedule of epsilon by the agent's settings; ``"constant"`` never changes."""
    start, end = agent.exploration_initial_eps, agent.exploration_final_eps
    if agent.exploration_decay == "constant":
        return FloatSchedule(start)
    if agent.exploration_fraction == 0:
        return FloatSchedule(end)
    if agent.exploration_decay == "exponential":
        return ExponentialSchedule(start, end, agent.exploration_fraction)
    return LinearSchedule(start, end, agent.exploration_fraction)


def _row(kind: float, schedule: ExponentialSchedule | LinearSchedule) -> ScheduleRow:
    return ScheduleRow(
        kind, float(schedule.start), float(schedule.end), float(schedule.end_fraction)
    )


def schedule_row(schedule: float | Schedule) -> ScheduleRow | None:
    """The schedule as four numbers; None for a Python function."""
    if isinstance(schedule, FloatSchedule):
        return schedule_row(schedule.value_schedule)
    if isinstance(schedule, ConstantSchedule):
        return schedule_row(schedule.val)
    if isinstance(schedule, LinearSchedule):
        return _row(LINEAR, schedule)
    if isinstance(schedule, ExponentialSchedule):
        return _row(EXPONENTIAL, schedule)
    if isinstance(schedule, int | float):
        return ScheduleRow(LINEAR, float(schedule), float(schedule), 1.0)
    return None
