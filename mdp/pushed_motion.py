"""Motion in one dimension whose velocity an action changes: a car between hills, a pendulum."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mdp.array_types import Floats
from mdp.machine_code import inlined


class PushedMotion(NamedTuple):
    """A point on a line or a circle, whose speed changes in a step and then its position.

        speed = clip(speed + pull(position) + push * action, -most_speed, most_speed)
        position = position + time_step * speed

    with pull(x) = ``pull_size`` cos(``pull_rate`` x + ``pull_phase``). A line has a wall on the
    left, which takes a point's speed, and on the right its goal, where the episode ends.

    Attributes:
        low: where the positions begin.
        high: where they end: at the goal, or on a circle where they begin again.
        is_circle: whether there is neither wall nor goal.
        push: change of speed for an action of 1.
        actions: all of them; of a continuous action the least and the greatest, shape (n,).
        is_continuous: whether all between these two are actions too.
        step_cost: of every step.
        position_cost: of a step, for the square of the position.
        speed_cost: of a step, for the square of the speed.
        action_cost: of a step, for the square of the action.
        final_cost: of not having come to the goal within the time limit.
        horizon: the time limit, in steps.
        rounding: by how much arithmetic may move position or speed in a step.
    """

    low: float
    high: float
    is_circle: bool
    most_speed: float
    time_step: float
    pull_size: float
    pull_rate: float
    pull_phase: float
    push: float
    actions: Floats
    is_continuous: bool
    step_cost: float
    position_cost: float
    speed_cost: float
    action_cost: float
    final_cost: float
    horizon: int
    rounding: float

    def pull(self, positions: Floats) -> Floats:
        """How the speed changes without an action, elementwise."""
        return self.pull_size * np.cos(self.pull_rate * positions + self.pull_phase)

    @property
    def pull_slope(self) -> float:
        """The most by which the pull differs between positions, for each unit of distance."""
        return abs(self.pull_size * self.pull_rate)


@inlined
def moved(
    motion: PushedMotion, position: float, speed: float, action: float
) -> tuple[float, float]:
    """Position and speed after a step; a position at or beyond ``high`` is at the goal."""
    pull = motion.pull_size * math.cos(motion.pull_rate * position + motion.pull_phase)
    speed = speed + pull + motion.push * action
    speed = min(max(speed, -motion.most_speed), motion.most_speed)
    position = position + motion.time_step * speed
    if motion.is_circle:
        span = motion.high - motion.low
        position = motion.low + (position - motion.low) % span
    elif position <= motion.low:
        position = motion.low
        speed = max(speed, 0.0)
    return position, speed
