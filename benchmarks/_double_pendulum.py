"""Two links on a hinge, of which the joint between them is driven: the acrobot.

How soon it can be up: a way that is short, and energies that no way exceeds.

Source: Spong (1995), "The swing up control problem for the acrobot", IEEE Control Systems 15;
Sutton and Barto, 1st edition, section 11.3.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from machine_code.compiling import called, compiled, inlined
from mdp.array_types import Floats, Ints

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


# --- how soon it can be up -----------------------------------------------------------------------

N_TORQUES = 3  # -1, 0 and 1

# Up is where the tip is a link above the hinge. Of these states the one with least energy is at
# rest, with the first link level: so much more than hanging down.
ENERGY_OF_BEING_UP = 24.5

# Of states nearer to each other than that, in radians and in 2 radians a second, one is kept.
NEARNESS = 0.2

Way = NDArray[np.int8]


@compiled
def way_up(start: Floats, width: int, most_steps: int) -> Way:
    """Torques, numbered from 0, that lead up from a state; empty where none were found.

    After each step it goes on from the ``width`` states that have the most energy and are not near
    to each other: a beam search.

    Args:
        start: angles and speeds, shape (4,).
        width: of the beam.
        most_steps: how long a way may be.
    """
    states = np.empty((width, 4))
    states[0], n_states = start, 1
    parents, torques = (
        np.empty((most_steps, width), np.int32),
        np.empty((most_steps, width), np.int8),
    )
    for step in range(most_steps):
        reached = np.empty((N_TORQUES * n_states, 4))
        energies = np.empty(len(reached))
        for place in range(len(reached)):
            one, torque = states[place // N_TORQUES], place % N_TORQUES - 1.0
            new = swung(Swing(one[0], one[1], one[2], one[3]), torque)
            if is_up(new):
                return _way_back(parents, torques, step, place)
            reached[place] = new.first, new.second, new.first_speed, new.second_speed
            energies[place] = energy(new)
        kept = _apart(reached, energies, width)
        n_states = len(kept)
        for i, place in enumerate(kept):
            states[i] = reached[place]
            parents[step, i], torques[step, i] = place // N_TORQUES, place % N_TORQUES
    return np.empty(0, np.int8)


@compiled
def _apart(states: Floats, energies: Floats, most: int) -> list[int]:
    """The places of states in different cells, those with the most energy first."""
    chosen, taken = [0 for _ in range(0)], {(0, 0, 0, 0)}
    taken.clear()
    for place in np.argsort(-energies):
        one = states[place] / NEARNESS
        cell = (
            math.floor(one[0]),
            math.floor(one[1]),
            math.floor(one[2] / 2),
            math.floor(one[3] / 2),
        )
        if cell not in taken:
            taken.add(cell)
            chosen.append(place)
        if len(chosen) == most:
            break
    return chosen


@compiled
def _way_back(parents: NDArray[np.int32], torques: Way, step: int, place: int) -> Way:
    way = np.empty(step + 1, np.int8)
    way[step] = place % N_TORQUES
    at = place // N_TORQUES
    for before in range(step - 1, -1, -1):
        way[before] = torques[before, at]
        at = parents[before, at]
    return way


@compiled
def greatest_energies(level: float, n_steps: int, n_angles: int) -> Floats:
    """The most energy within 0, 1, ... steps from states that have so much, shape (n_steps + 1,).

    Sought among states on a grid of the two angles and of the direction of the speeds, and all
    sequences of torques of -1 and 1: it may be missed by a little, between these.
    """
    greatest = np.full(n_steps + 1, level)
    path, tried = np.empty((n_steps + 1, 4)), np.empty(n_steps + 1, np.int64)
    widest = _widest_angles(level)
    for i in range(n_angles):
        first = widest[0] * (2 * i / (n_angles - 1) - 1)
        for j in range(n_angles):
            second = widest[1] * (2 * j / (n_angles - 1) - 1)
            resting = height_energy(first, second)
            # Half of the directions will do: mirrored states gain as much by mirrored torques.
            for k in range(n_angles // 2 if resting <= level else 0):
                direction = 2 * math.pi * k / n_angles
                spin, whirl = math.cos(direction), math.sin(direction)
                unit = energy(Swing(first, second, spin, whirl)) - resting
                speed = math.sqrt((level - resting) / unit)
                start = Swing(first, second, speed * spin, speed * whirl)
                _climb(start, greatest, path, tried)
    return greatest


@compiled
def _widest_angles(level: float) -> tuple[float, float]:
    """How far the links can be from hanging down with so much energy."""
    by_first, by_second = 1.5 * GRAVITY, 0.5 * GRAVITY
    first = math.acos(max(1 - level / by_first, -1.0))
    # With the first link where it leaves the second most.
    left = max(by_first + by_second - level, by_first - by_second)
    second = math.acos((left**2 - by_first**2 - by_second**2) / (2 * by_first * by_second))
    return first, second


@compiled
def _climb(start: Swing, greatest: Floats, path: Floats, tried: Ints) -> None:
    """Raise ``greatest`` to what sequences of torques lead to: a search in depth.

    Without recursion, which a cache of machine code does not bear. ``path``, of shape
    (n_steps + 1, 4), and ``tried``, of shape (n_steps + 1,), are room to work in.
    """
    depth, tried[0] = 0, 0
    path[0] = start.first, start.second, start.first_speed, start.second_speed
    while depth >= 0:
        if depth == len(greatest) - 1 or tried[depth] == 2:
            depth -= 1
            continue
        at, torque = path[depth], 2.0 * tried[depth] - 1.0
        tried[depth] += 1
        depth += 1
        new = swung(Swing(at[0], at[1], at[2], at[3]), torque)
        path[depth] = new.first, new.second, new.first_speed, new.second_speed
        tried[depth] = 0
        greatest[depth] = max(greatest[depth], energy(new))


def fewest_steps(levels: Floats, greatest: Floats, start: float, goal: float) -> int:
    """How many steps it takes at least from one energy to another.

    Args:
        levels: energies, shape (n,), rising from 0.
        greatest: the most energy within 0, 1, ... steps from each, shape (n, n_steps + 1). Between
            levels, what is gained is interpolated.
        start: energy at the beginning.
        goal: energy that is asked for.
    """
    gains = np.maximum.accumulate(greatest - levels[:, None], axis=0)
    known = [start]
    while known[-1] < goal:
        n_steps = len(known)
        bounds = [
            known[n_steps - m] + np.interp(known[n_steps - m], levels, gains[:, m])
            for m in range(1, min(n_steps, gains.shape[1] - 1) + 1)
        ]
        known.append(float(min(bounds)))
    return len(known) - 1
