"""Tells what the bins do to a course's Q-learning and SARSA on CartPole, in a plain program.

    python benchmarks/coursework_cartpole.py               # seeds 0 to 199: two minutes
    python benchmarks/coursework_cartpole.py --seeds 3000

The slides cut pole angle and angular velocity into "50 bins", and do not say how: 50 cells of equal
width between the ends; 50 edges between them, which NumPy's ``digitize`` turns into 51 cells, two
of them outside; or the nearest of 50 points. The study ``studies/cartpole-qlearning-vs-sarsa.yml``
does the first through the library; this program owes it nothing, so that the two can be held
against each other. Figures are mean returns of the 500 episodes up to the one named, and of the
greedy policy over 100 episodes of at most 500 steps, each with its standard error over seeds.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

import numba
import numpy as np
from rich.console import Console
from rich.table import Table

N_EPISODES, ROW, TIME_LIMIT = 5000, 500, 500
ROWS = (500, 1500, 2500, 3500, 4500, 5000)
N_GREEDY = 100
STEP_SIZE, DISCOUNT, EPSILON = 0.25, 0.95, 0.2
ANGLE, VELOCITY = 0.41887903, math.radians(50)

EQUAL_CELLS, EDGES, POINTS = range(3)
BINNINGS = {"50 equal cells": EQUAL_CELLS, "50 edges": EDGES, "50 points": POINTS}
N_CELLS = 51  # the most that a dimension has


@numba.njit(cache=False)
def pushed(cart: Any, to_the_right: bool) -> Any:
    """The cart's next position, velocity, pole angle and angular velocity (Barto et al., 1983)."""
    x, x_speed, angle, speed = cart
    force = 10.0 if to_the_right else -10.0
    cosine, sine = math.cos(angle), math.sin(angle)
    push = (force + 0.05 * speed * speed * sine) / 1.1
    turn = (9.8 * sine - cosine * push) / (0.5 * (4 / 3 - 0.1 * cosine * cosine / 1.1))
    shift = push - 0.05 * turn * cosine / 1.1
    return x + 0.02 * x_speed, x_speed + 0.02 * shift, angle + 0.02 * speed, speed + 0.02 * turn


@numba.njit(cache=False)
def has_fallen(cart: Any) -> bool:
    """Whether the cart has left the track or the pole leans by more than 12 degrees."""
    return bool(abs(cart[0]) > 2.4 or abs(cart[2]) > math.radians(12))


@numba.njit(cache=False)
def upright() -> Any:
    """Where an episode begins."""
    low, high = -0.05, 0.05
    return (
        np.random.uniform(low, high),  # noqa: NPY002  # Numba compiles no other generator's
        np.random.uniform(low, high),  # noqa: NPY002
        np.random.uniform(low, high),  # noqa: NPY002
        np.random.uniform(low, high),  # noqa: NPY002
    )


@numba.njit(cache=False)
def cell(value: float, end: float, binning: int) -> int:
    """The cell of a value, which environments show in single precision."""
    distance = float(np.float32(value)) + end
    if binning == EQUAL_CELLS:
        return int(min(max(math.floor(distance / (2 * end) * 50), 0), 49))
    if binning == EDGES:
        return int(min(max(math.floor(distance / (2 * end) * 49) + 1, 0), 50))
    return int(min(max(round(distance / (2 * end) * 49), 0), 49))


@numba.njit(cache=False)
def seen(cart: Any, binning: int) -> Any:
    """Angle and angular velocity as cells."""
    return cell(cart[2], ANGLE, binning), cell(cart[3], VELOCITY, binning)


@numba.njit(cache=False)
def chosen(values: Any, epsilon: float) -> int:
    """An action, epsilon-greedily; the first of two that are alike."""
    if np.random.random() < epsilon:  # noqa: NPY002
        return np.random.randint(2)  # noqa: NPY002
    return int(values[1] > values[0])


@numba.njit(cache=False)
def learn_an_episode(table: Any, binning: int, on_policy: bool, corrected: bool) -> int:
    """Play and learn; returns the steps. As printed, the last step teaches nothing."""
    cart = upright()
    at = seen(cart, binning)
    action = chosen(table[at], EPSILON)
    for t in range(TIME_LIMIT if corrected else 2**62):
        cart = pushed(cart, action == 1)
        fallen = has_fallen(cart)
        if fallen and not corrected:
            return t + 1
        reached = seen(cart, binning)
        next_action = chosen(table[reached], EPSILON)
        expected = table[reached][next_action] if on_policy else max(table[reached])
        target = 1 + (0.0 if fallen else DISCOUNT * expected)
        table[at][action] += STEP_SIZE * (target - table[at][action])
        if fallen:
            return t + 1
        # SARSA has committed itself; Q-learning chooses by what it has just learnt.
        at, action = reached, next_action if on_policy else chosen(table[reached], EPSILON)
    return TIME_LIMIT


@numba.njit(cache=False)
def greedy_steps(table: Any, binning: int) -> int:
    """The steps of an episode of the greedy policy."""
    cart = upright()
    for t in range(TIME_LIMIT):
        cart = pushed(cart, chosen(table[seen(cart, binning)], 0.0) == 1)
        if has_fallen(cart):
            return t + 1
    return TIME_LIMIT


@numba.njit(cache=False, parallel=True)
def figures(n_seeds: int, binning: int, on_policy: bool, corrected: bool) -> Any:
    """The rows and the greedy policy's mean of each seed, shape (n_seeds, 7)."""
    result = np.zeros((n_seeds, len(ROWS) + 1))
    for seed in numba.prange(n_seeds):
        np.random.seed(seed)  # noqa: NPY002
        table = np.random.normal(0, 1, (N_CELLS, N_CELLS, 2))  # noqa: NPY002
        steps = np.zeros(N_EPISODES)
        for episode in range(N_EPISODES):
            steps[episode] = learn_an_episode(table, binning, on_policy, corrected)
        for k, row in enumerate(ROWS):
            result[seed, k] = steps[row - ROW : row].mean()
        for _ in range(N_GREEDY):
            result[seed, -1] += greedy_steps(table, binning) / N_GREEDY
    return result


def main() -> None:
    """Print the figures of each way to cut."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=200, metavar="N", help="seeds 0 to N-1")
    n_seeds = parser.parse_args().seeds
    table = Table("bins", "rule", "", *map(str, ROWS), "greedy", title=f"seeds 0 to {n_seeds - 1}")
    for name, binning in BINNINGS.items():
        for corrected in (False, True):
            for rule, on_policy in (("Q-learning", False), ("SARSA", True)):
                found = figures(n_seeds, binning, on_policy, corrected)
                errors = found.std(axis=0) / math.sqrt(n_seeds)
                cells = [
                    f"{mean:.1f} ± {error:.1f}"
                    for mean, error in zip(found.mean(axis=0), errors, strict=True)
                ]
                table.add_row(name, rule, "corrected" if corrected else "as printed", *cells)
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
