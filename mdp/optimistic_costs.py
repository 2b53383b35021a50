"""What no policy can go below: least costs to go of a `PushedMotion`, rounded down over cells.

Positions and speeds are cut into cells. A cell's cost is the least that any action leads to from
any state in it, where a state that comes into a cell may begin anew anywhere in that cell. So it is
at most the least cost of each state in it, and comes near as cells get small. Everything that is
rounded is rounded down.

Source: the optimistic abstraction of a continuous system, as in Girard, Pola and Tabuada (2010),
"Approximately bisimilar symbolic models for incrementally stable switched systems", IEEE TAC 55.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mdp.array_types import Floats, Ints
from mdp.machine_code import kernel
from mdp.pushed_motion import PushedMotion

Singles = NDArray[np.float32]

# Two sums in a step are rounded to single precision, each by half of this at most.
SINGLE_ROUNDING = 2.0**-23


class Cells(NamedTuple):
    """A grid of cells.

    Attributes:
        positions: the lower ends of the cells' positions, shape (P,).
        speeds: the lower ends of their speeds, shape (S,).
        width: of a cell's positions.
        height: of its speeds.
    """

    positions: Floats
    speeds: Floats
    width: float
    height: float


def cells_of(motion: PushedMotion, n_positions: int, n_speeds: int) -> Cells:
    """Cells of one size."""
    width = (motion.high - motion.low) / n_positions
    height = 2 * motion.most_speed / n_speeds
    return Cells(
        np.asarray(motion.low + width * np.arange(n_positions), np.float64),
        np.asarray(-motion.most_speed + height * np.arange(n_speeds), np.float64),
        width,
        height,
    )


def optimistic_costs(motion: PushedMotion, cells: Cells) -> Floats:
    """The least that a policy can cost from each cell, with the whole time limit ahead.

    Returns:
        At most the least expected cost of each state in the cell, shape (P, S). It holds for every
        policy, also for those that draw their actions or remember what was.
    """
    first, costs = push_costs(motion, cells)
    low, high = _drifts(motion, cells)
    stage = rounded_down(_stage_costs(motion, cells))
    room = int(max(np.abs(first).max(), (first + costs.shape[1]).max())) + 1
    after_push = np.empty((len(cells.positions), len(cells.speeds) + 2 * room), np.float32)
    now, then = np.full_like(stage, motion.final_cost), np.empty_like(stage)
    at_rest = resting_rows(motion, cells)
    for _ in range(motion.horizon):
        if motion.is_circle:
            drift_on_circle(now, low, high, after_push, room)
        else:
            drift_on_line(now, low, high, at_rest, after_push, room)
        push(after_push, first, costs, stage, then, room)
        if np.array_equal(now, then):
            break
        now, then = then, now
    return np.asarray(now.astype(np.float64) * (1 - SINGLE_ROUNDING) ** motion.horizon)


def mean_cost(
    motion: PushedMotion,
    cells: Cells,
    costs: Floats,
    positions: tuple[float, float],
    speeds: tuple[float, float],
) -> float:
    """The mean of the cells' costs over starts that are uniform in a rectangle, or at rest.

    Args:
        motion: the motion.
        cells: its cells.
        costs: from `optimistic_costs`.
        positions: from where to where.
        speeds: likewise; (0, 0) for starts at rest.
    """
    in_columns = _shares(cells.positions, cells.width, positions)
    if speeds == (0.0, 0.0):
        by_column = costs[:, resting_rows(motion, cells)].min(axis=1)
    else:
        by_column = costs @ _shares(cells.speeds, cells.height, speeds)
    return float(in_columns @ by_column)


def resting_rows(motion: PushedMotion, cells: Cells) -> Ints:
    """The rows of cells in which the speed can be 0."""
    near = motion.rounding
    return np.flatnonzero((cells.speeds <= near) & (cells.speeds + cells.height >= -near))


def push_costs(motion: PushedMotion, cells: Cells) -> tuple[Ints, Singles]:
    """What it costs at least to come from a row of speeds into another one.

    Returns:
        By column of positions, how many rows further the first reachable one lies, shape (P,); and
        the least cost of an action that leads into it and into those that follow, shape (P, M):
        infinite where none does.
    """
    middle = motion.pull(cells.positions + cells.width / 2)
    slack = motion.pull_slope * cells.width / 2 + motion.rounding
    reach = motion.push * motion.actions
    first = np.floor((middle - slack + reach.min()) / cells.height).astype(np.int64)
    last = np.floor((middle + slack + reach.max()) / cells.height).astype(np.int64) + 1
    rows = first[:, None] + np.arange((last - first).max() + 1)
    # Between two states of these rows the speed changes by less than a row more, or less.
    low = ((rows - 1) * cells.height - (middle + slack)[:, None]) / motion.push
    high = ((rows + 1) * cells.height - (middle - slack)[:, None]) / motion.push
    return first, rounded_down(_action_costs(motion, low, high))


def _action_costs(motion: PushedMotion, low: Floats, high: Floats) -> Floats:
    """The least cost of an action between two bounds, elementwise; infinite where there is none."""
    if not motion.is_continuous:
        fits = [np.where((low <= a) & (a <= high), a**2, np.inf) for a in motion.actions]
        squares = np.min(fits, axis=0)
    else:
        low = np.maximum(low, motion.actions.min())
        high = np.minimum(high, motion.actions.max())
        squares = np.where(low <= high, np.maximum(np.maximum(low, -high), 0.0) ** 2, np.inf)
    known = np.isfinite(squares)
    return np.where(known, motion.action_cost * np.where(known, squares, 0.0), np.inf)


def _drifts(motion: PushedMotion, cells: Cells) -> tuple[Ints, Ints]:
    """By row, how many columns further the first and the last lie that a state moves into, (S,)."""
    slowest, fastest = cells.speeds, cells.speeds + cells.height
    low = np.floor((motion.time_step * slowest - motion.rounding) / cells.width)
    high = np.floor((motion.time_step * fastest + motion.rounding) / cells.width) + 1
    return low.astype(np.int64), high.astype(np.int64)


def _stage_costs(motion: PushedMotion, cells: Cells) -> Floats:
    """The least cost of a step from each cell, but for the action's, shape (P, S)."""
    x = _nearest_to_zero(cells.positions, cells.width, motion.rounding)
    v = _nearest_to_zero(cells.speeds, cells.height, motion.rounding)
    by_column = motion.step_cost + motion.position_cost * x**2
    return np.asarray(by_column[:, None] + motion.speed_cost * v[None] ** 2)


def _nearest_to_zero(low: Floats, size: float, rounding: float) -> Floats:
    return np.asarray(np.maximum(np.maximum(low, -(low + size)) - rounding, 0.0))


def _shares(low: Floats, size: float, span: tuple[float, float]) -> Floats:
    """How much of a span lies in each cell."""
    overlap = np.minimum(low + size, span[1]) - np.maximum(low, span[0])
    return np.asarray(np.maximum(overlap, 0.0) / (span[1] - span[0]))


def rounded_down(values: Floats) -> Singles:
    """In single precision, and no higher."""
    singles = values.astype(np.float32)
    below = np.nextafter(singles, np.float32(-np.inf))
    return np.where(singles > values, below, singles).astype(np.float32)


@kernel
def drift_on_circle(costs: Singles, low: Ints, high: Ints, drifted: Singles, room: int) -> None:
    """The least cost of a column's position and a row's new speed, where positions wrap round.

    ``drifted`` has the rows of ``costs`` in its middle, with ``room`` at both ends.
    """
    n_columns, n_rows = costs.shape
    for column in range(n_columns):
        for row in range(n_rows):
            best = np.float32(np.inf)
            for step in range(low[row], high[row] + 1):
                place = column + step
                if place >= n_columns:
                    place -= n_columns
                elif place < 0:
                    place += n_columns
                best = min(best, costs[place, row])
            drifted[column, room + row] = best


@kernel
def drift_on_line(
    costs: Singles, low: Ints, high: Ints, at_rest: Ints, drifted: Singles, room: int
) -> None:
    """As `drift_on_circle`, with a wall on the left and the goal on the right."""
    n_columns, n_rows = costs.shape
    at_wall = np.float32(np.inf)
    for row in at_rest:
        at_wall = min(at_wall, costs[0, row])
    for column in range(n_columns):
        for row in range(n_rows):
            first, last = column + low[row], column + high[row]
            best = at_wall if first < 0 else np.float32(np.inf)
            for place in range(max(first, 0), min(last, n_columns - 1) + 1):
                best = min(best, costs[place, row])
            drifted[column, room + row] = np.float32(0.0) if last >= n_columns else best


@kernel
def push(
    drifted: Singles, first: Ints, costs: Singles, stage: Singles, pushed: Singles, room: int
) -> None:
    """The least cost of each cell, from what the next speeds are worth. Speeds are clipped."""
    n_columns, n_rows = pushed.shape
    for column in range(n_columns):
        ahead, best = drifted[column], pushed[column]
        ahead[:room] = ahead[room]
        ahead[room + n_rows :] = ahead[room + n_rows - 1]
        best[:] = np.float32(np.inf)
        for m in range(costs.shape[1]):
            cost = costs[column, m]
            if cost == np.inf:
                continue
            begin = room + first[column] + m
            reached = ahead[begin : begin + n_rows]
            for row in range(n_rows):
                best[row] = min(best[row], reached[row] + cost)
        for row in range(n_rows):
            best[row] += stage[column, row]
