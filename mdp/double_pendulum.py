"""Two links on a hinge, of which the joint between them is driven: the acrobot.

Source: Spong (1995), "The swing up control problem for the acrobot", IEEE Control Systems 15;
Sutton and Barto, 1st edition, section 11.3.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mdp.array_types import Floats
from mdp.machine_code import called, compiled, inlined

# Both links are 1 long and weigh 1, with their weight in the middle and a moment of inertia of 1.
GRAVITY = 9.8
TIME_STEP = 0.2
MOST_SPEEDS = (4 * math.pi, 9 * math.pi)


class Swing(NamedTuple):
    """A state: the angles of both links, the second against the first, and their speeds."""

    first: float
    second: float
    first_speed: float
    second_speed: float


@inlined
def rates(state: Swing, torque: float) -> Swing:
    """How fast the parts of a state change."""
    spin, whirl = state.first_speed, state.second_speed
    cosine, sine = math.cos(state.second), math.sin(state.second)
    inertia, coupling = 3.5 + cosine, 1.25 + 0.5 * cosine
    weight_2 = 0.5 * GRAVITY * math.cos(state.first + state.second - math.pi / 2)
    weight_1 = 1.5 * GRAVITY * math.cos(state.first - math.pi / 2) + weight_2
    weight_1 -= (0.5 * whirl + spin) * whirl * sine
    turn_2 = torque + coupling / inertia * weight_1 - 0.5 * spin * spin * sine - weight_2
    turn_2 /= 1.25 - coupling * coupling / inertia
    turn_1 = -(coupling * turn_2 + weight_1) / inertia
    return Swing(spin, whirl, turn_1, turn_2)


@inlined
def shifted(state: Swing, rate: Swing, time: float) -> Swing:
    """A state some time later, at these rates."""
    return Swing(
        state.first + time * rate.first,
        state.second + time * rate.second,
        state.first_speed + time * rate.first_speed,
        state.second_speed + time * rate.second_speed,
    )


@inlined
def turned(angle: float) -> float:
    """The same angle between -pi and pi."""
    return angle - 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))


@called
def swung(state: Swing, torque: float) -> Swing:
    """A step: Runge and Kutta's of fourth order, with the torque as it is."""
    one = rates(state, torque)
    two = rates(shifted(state, one, TIME_STEP / 2), torque)
    three = rates(shifted(state, two, TIME_STEP / 2), torque)
    four = rates(shifted(state, three, TIME_STEP), torque)
    state = shifted(state, one, TIME_STEP / 6)
    state = shifted(state, two, TIME_STEP / 3)
    state = shifted(state, three, TIME_STEP / 3)
    state = shifted(state, four, TIME_STEP / 6)
    most_1, most_2 = MOST_SPEEDS
    return Swing(
        turned(state.first),
        turned(state.second),
        min(max(state.first_speed, -most_1), most_1),
        min(max(state.second_speed, -most_2), most_2),
    )


@inlined
def is_up(state: Swing) -> bool:
    """Whether the tip is more than a link above the hinge."""
    return -math.cos(state.first) - math.cos(state.first + state.second) > 1.0


@inlined
def height_energy(first: float, second: float) -> float:
    """Energy of the links' places, 0 where they hang down."""
    return GRAVITY * (2 - 1.5 * math.cos(first) - 0.5 * math.cos(first + second))


@inlined
def energy(state: Swing) -> float:
    """Energy of places and speeds, 0 at rest where the links hang down."""
    spin, whirl, cosine = state.first_speed, state.second_speed, math.cos(state.second)
    moving = (3.5 + cosine) * spin * spin + (2.5 + cosine) * spin * whirl + 1.25 * whirl * whirl
    return moving / 2 + height_energy(state.first, state.second)


@compiled
def after_torques(start: Floats, torques: Floats) -> Floats:
    """The states that torques lead to one after the other, shape (len(torques), 4)."""
    states = np.empty((len(torques), 4))
    state = Swing(start[0], start[1], start[2], start[3])
    for step in range(len(torques)):
        state = swung(state, torques[step])
        states[step] = state.first, state.second, state.first_speed, state.second_speed
    return states
