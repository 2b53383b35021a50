"""Motion in one dimension that actions push: Gymnasium's cars and its pendulum, and their costs.

Least costs to go are worked out twice. Over cells they are what no policy can go below: positions
and speeds are cut into cells, and a cell's cost is the least that any action leads to from any
state in it, where a state that comes into a cell may begin anew anywhere in that cell. So it is at
most the least cost of each state in it, and comes near as cells get small. Everything that is
rounded is rounded down. At nodes of a grid, and interpolated between them, costs are no bound, but
make a good policy. What that is worth is what it gets where it is played.

Sources: of cells, the optimistic abstraction of a continuous system, as in Girard, Pola and Tabuada
(2010), "Approximately bisimilar symbolic models for incrementally stable switched systems", IEEE
TAC 55; of nodes, Munos and Moore (2002), "Variable resolution discretization in optimal control",
Machine Learning 49, section 2, on a uniform grid.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from machine_code.compiling import inlined, kernel
from mdp.array_types import Floats, Ints

Singles = NDArray[np.float32]


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


# --- Gymnasium's, with default arguments ---------------------------------------------------------

# Both cars, but for their goals and engines.
_CAR = PushedMotion(
    low=-1.2,
    high=0.5,
    is_circle=False,
    most_speed=0.07,
    time_step=1.0,
    pull_size=-0.0025,
    pull_rate=3.0,
    pull_phase=0.0,
    push=0.001,
    actions=np.array([-1.0, 0.0, 1.0]),
    is_continuous=False,
    step_cost=1.0,
    position_cost=0.0,
    speed_cost=0.0,
    action_cost=0.0,
    final_cost=0.0,
    horizon=200,
    rounding=1e-9,
)
MOTIONS = {
    "MountainCar-v0": _CAR,
    # It keeps its state in single precision. A return is 100 less the cost, which is 100 where the
    # goal is not reached.
    "MountainCarContinuous-v0": _CAR._replace(
        high=0.45,
        push=0.0015,
        actions=np.array([-1.0, 1.0]),
        is_continuous=True,
        step_cost=0.0,
        action_cost=0.1,
        final_cost=100.0,
        horizon=999,
        rounding=1e-6,
    ),
    "Pendulum-v1": PushedMotion(
        low=-math.pi,
        high=math.pi,
        is_circle=True,
        most_speed=8.0,
        time_step=0.05,
        pull_size=0.75,
        pull_rate=1.0,
        pull_phase=-math.pi / 2,
        push=0.15,
        actions=np.array([-2.0, 2.0]),
        is_continuous=True,
        step_cost=0.0,
        position_cost=1.0,
        speed_cost=0.1,
        action_cost=0.001,
        final_cost=0.0,
        horizon=200,
        rounding=1e-9,
    ),
}
# A return is this, less the cost.
COST_FREE_RETURN = {"MountainCar-v0": 0.0, "MountainCarContinuous-v0": 100.0, "Pendulum-v1": 0.0}
# Where episodes begin: uniform positions from and to, and speeds.
STARTS = {
    "MountainCar-v0": ((-0.6, -0.4), (0.0, 0.0)),
    "MountainCarContinuous-v0": ((-0.6, -0.4), (0.0, 0.0)),
    "Pendulum-v1": ((-math.pi, math.pi), (-1.0, 1.0)),
}


# --- what no policy can go below -----------------------------------------------------------------

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


# --- a good policy -------------------------------------------------------------------------------


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
