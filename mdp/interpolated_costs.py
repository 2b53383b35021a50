"""A good policy for a `PushedMotion`: least costs to go at nodes of a grid, and between them.

Interpolated costs are no bound. What the policy is worth is what it gets where it is played.

Source: Munos and Moore (2002), "Variable resolution discretization in optimal control", Machine
Learning 49, section 2, on a uniform grid.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mdp.array_types import Floats
from mdp.machine_code import inlined, kernel
from mdp.pushed_motion import PushedMotion, moved

Singles = NDArray[np.float32]


def interpolated_costs(
    motion: PushedMotion, n_positions: int, n_speeds: int, actions: Floats
) -> Singles:
    """Least costs at nodes, by the steps that are left.

    Args:
        motion: the motion.
        n_positions: nodes from its lowest to its highest position.
        n_speeds: nodes from its greatest speed to the left to that to the right.
        actions: to choose from, shape (A,).

    Returns:
        Of shape (horizon + 1, n_positions, n_speeds): at each node with 0, 1, ... steps left.
    """
    costs = np.empty((motion.horizon + 1, n_positions, n_speeds), np.float32)
    costs[0] = motion.final_cost
    for left in range(motion.horizon):
        back_up(motion, actions, costs[left], costs[left + 1])
    return costs


@inlined
def interpolated(motion: PushedMotion, costs: Singles, position: float, speed: float) -> float:
    """The cost between the four nodes around a state; 0 at the goal."""
    n_positions, n_speeds = costs.shape
    if position >= motion.high:
        return 0.0
    column = (position - motion.low) / (motion.high - motion.low) * (n_positions - 1)
    row = (speed / motion.most_speed + 1) / 2 * (n_speeds - 1)
    i, j = min(int(column), n_positions - 2), min(int(row), n_speeds - 2)
    x, v = column - i, row - j
    before = (1 - v) * costs[i, j] + v * costs[i, j + 1]
    after = (1 - v) * costs[i + 1, j] + v * costs[i + 1, j + 1]
    return float((1 - x) * before + x * after)


@kernel
def best_action(
    motion: PushedMotion, actions: Floats, costs: Singles, position: float, speed: float
) -> tuple[float, float]:
    """The action that costs least in the end, and what it costs beside the state's own cost.

    Args:
        motion: the motion.
        actions: to choose from, shape (A,).
        costs: at the nodes, with a step less, shape (n_positions, n_speeds).
        position: of the state.
        speed: likewise.
    """
    least, best = np.inf, 0.0
    for action in actions:
        next_position, next_speed = moved(motion, position, speed, action)
        cost = motion.action_cost * action**2
        cost += interpolated(motion, costs, next_position, next_speed)
        if cost < least:
            least, best = cost, action
    return best, least


@kernel
def back_up(motion: PushedMotion, actions: Floats, after: Singles, before: Singles) -> None:
    """Costs at the nodes with a step more: ``before`` from ``after``."""
    n_positions, n_speeds = after.shape
    for i in range(n_positions):
        position = motion.low + (motion.high - motion.low) * i / (n_positions - 1)
        for j in range(n_speeds):
            speed = motion.most_speed * (2 * j / (n_speeds - 1) - 1)
            _, least = best_action(motion, actions, after, position, speed)
            own = motion.position_cost * position**2 + motion.speed_cost * speed**2
            before[i, j] = motion.step_cost + own + least
