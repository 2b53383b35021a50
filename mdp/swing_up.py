"""How soon a double pendulum can be up: a way that is short, and energies that no way exceeds."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mdp.array_types import Floats, Ints
from mdp.double_pendulum import GRAVITY, Swing, energy, height_energy, is_up, swung
from mdp.machine_code import compiled

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
