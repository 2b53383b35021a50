"""A car on a racetrack, that has a velocity and steers by changing it."""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from typing import ClassVar

import numpy as np

from rl_yardstick.envs.argument_checks import check_choice, check_number
from rl_yardstick.envs.finite_env import summing_to_one
from rl_yardstick.envs.grid import MapEnv
from rl_yardstick.mdp.transition_model import Bools, Ints, TransitionModel

# Figure 5.5. The car goes up and to the right: it starts at the bottom and ends on the right side.
LEFT_TRACK = (
    "###.............G",
    "##..............G",
    "##..............G",
    "#...............G",
    "................G",
    "................G",
    "..........#######",
    *[".........########"] * 7,
    *["#........########"] * 8,
    *["##.......########"] * 7,
    *["###......########"] * 2,
    "###SSSSSS########",
)
RIGHT_TRACK = (
    "################...............G",
    "#############..................G",
    "############...................G",
    *["###########....................G"] * 4,
    "############...................G",
    "#############..................G",
    "##############................##",
    "##############.............#####",
    "##############............######",
    "##############..........########",
    "##############.........#########",
    "#############..........#########",
    "############...........#########",
    "###########............#########",
    "##########.............#########",
    "#########..............#########",
    "########...............#########",
    "#######................#########",
    "######.................#########",
    "#####..................#########",
    "####...................#########",
    "###....................#########",
    "##.....................#########",
    "#......................#########",
    *["." * 23 + "#" * 9] * 2,
    "S" * 23 + "#" * 9,
)
TRACKS = {"left": LEFT_TRACK, "right": RIGHT_TRACK}
N_SPEEDS = 5
CRASH = -1


class RacetrackEnv(MapEnv):
    """A car is to take a turn as fast as it can without leaving the track.

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), exercise 5.12, on the tracks of figure
    5.5. The car has a place and a velocity, in cells a step, upwards and to the right: each is from
    0 to 4, and both are 0 only on the starting line. An action changes each by -1, 0 or 1; with
    probability .1 neither changes, whatever was chosen. A change is left out if it would lead out
    of 0 to 4, or if it would stop the car outside the starting line.

    Then the car moves along a straight line to its new cell. If the line enters a cell of the
    finishing line `G`, the episode ends, whatever lies beyond; if before that it enters one off the
    track (`#`, or beyond the map), the car is put back to a cell of the starting line `S`, all with
    equal probability, and stands still; the episode goes on. Corners are not entered: a line
    through a corner goes on into the cell across it.

    ## Action Space
    `Discrete(9)`: 3 times the change upwards plus the change to the right, each counted 0 for -1, 1
    for 0 and 2 for 1.

    ## Observation Space
    `Discrete(25 * n_cells)`: 25 times the number of the cell, 5 times the velocity upwards, and the
    velocity to the right. Cells of the track are counted row by row from the top left; the left
    track has 298, the right one 515.

    ## Rewards
    -1 a step, until the finishing line is crossed.

    ## Starting State
    Any cell of the starting line, all with equal probability, standing still.

    ## Episode End
    The episode terminates when the car crosses the finishing line. It is truncated after 1000 steps
    when made by `gymnasium.make`.

    ## Arguments
    - `track="left"`: or `"right"`, as in the figure
    - `noise=0.1`: probability that the velocity does not change
    - `step_reward=-1`: the reward of each step
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    action_names: ClassVar[tuple[str, ...]] = tuple(
        f"up {up:+d}, right {right:+d}" for up in (-1, 0, 1) for right in (-1, 0, 1)
    )

    def __init__(
        self,
        track: str = "left",
        noise: float = 0.1,
        step_reward: float = -1,
        render_mode: str | None = None,
    ) -> None:
        self.track = check_choice("track", track, tuple(TRACKS))
        self.noise = check_number("noise", noise, 0, 1)
        self.step_reward = check_number("step_reward", step_reward)
        self.rows = TRACKS[self.track]
        self._cells = _cells_of(self.rows)
        super().__init__(len(self._cells) * N_SPEEDS**2, 9, render_mode)

    def transition_model(self) -> TransitionModel:
        return _model(self.track, self.noise, self.step_reward)

    def cell_of(self, state: int) -> int:
        """Where the car is, cells of the map counted row by row."""
        return int(self._cells[state // N_SPEEDS**2])


def crossed_cells(up: int, right: int) -> list[tuple[int, int]]:
    """The cells that a straight line enters, to the cell ``up`` rows up and ``right`` to the right.

    In order; of each cell, how many rows up and columns to the right it lies.
    """
    # The line leaves a row, or a column, halfway between two middles.
    rows = {Fraction(2 * i + 1, 2 * up) for i in range(up)}
    columns = {Fraction(2 * i + 1, 2 * right) for i in range(right)}
    cells = [(0, 0)]
    for moment in sorted(rows | columns):
        row, column = cells[-1]
        cells.append((row + (moment in rows), column + (moment in columns)))
    return cells[1:]


def _cells_of(rows: tuple[str, ...]) -> Ints:
    """The cells of the track, numbered row by row on the map."""
    return np.flatnonzero(np.array(list("".join(rows))) != "#")


def _arrivals(rows: tuple[str, ...]) -> tuple[Ints, Bools]:
    """The cell that a car reaches from each cell at each velocity, and whether it finishes.

    The number of a cell of the track, or `CRASH`, and the flag, both of shape (cells, 25).
    """
    places = {divmod(int(cell), len(rows[0])): i for i, cell in enumerate(_cells_of(rows))}
    arrival = np.full((len(places), N_SPEEDS**2), CRASH)
    finished = np.zeros(arrival.shape, np.bool_)
    for velocity in range(N_SPEEDS**2):
        path = crossed_cells(*divmod(velocity, N_SPEEDS)) or [(0, 0)]
        for (row, column), here in places.items():
            for up, right in path:
                arrival[here, velocity] = places.get((row - up, column + right), CRASH)
                if arrival[here, velocity] == CRASH:
                    break
                if rows[row - up][column + right] == "G":
                    finished[here, velocity] = True
                    break
    return arrival, finished


def _new_velocities(is_start: Bools) -> Ints:
    """The velocity after each action, by cell and velocity, shape (cells, 25, 9)."""
    velocity, action = np.arange(N_SPEEDS**2)[:, None], np.arange(9)
    parts = zip(np.divmod(velocity, N_SPEEDS), np.divmod(action, 3), strict=True)
    up, right = (np.clip(part + change - 1, 0, N_SPEEDS - 1) for part, change in parts)
    wanted = up * N_SPEEDS + right
    stops = (wanted == 0) & ~is_start[:, None, None]
    return np.where(stops, velocity, wanted)


@lru_cache(maxsize=2)
def _model(track: str, noise: float, step_reward: float) -> TransitionModel:
    rows = TRACKS[track]
    letters = np.array(list("".join(rows)))[_cells_of(rows)]
    starts = np.flatnonzero(letters == "S")
    arrival, finished = _arrivals(rows)
    cell = np.arange(len(letters))[:, None, None]
    changed = _new_velocities(letters == "S")
    same = np.broadcast_to(np.arange(N_SPEEDS**2)[:, None], changed.shape)

    # Two outcomes by velocity, then one for each cell of the starting line.
    shape = (*changed.shape, 2 + len(starts))
    prob, next_state = np.zeros(shape), np.zeros(shape, np.int32)
    terminated = np.zeros(shape, np.bool_)
    next_state[..., 2:] = starts * N_SPEEDS**2
    for k, (chance, velocity) in enumerate(((1 - noise, changed), (noise, same))):
        crashed = arrival[cell, velocity] == CRASH
        prob[..., k] = np.where(crashed, 0, chance)
        prob[..., 2:] += np.where(crashed, chance / len(starts), 0)[..., None]
        next_state[..., k] = np.where(crashed, 0, arrival[cell, velocity] * N_SPEEDS**2 + velocity)
        terminated[..., k] = finished[cell, velocity] & ~crashed

    rest = (-1, 9, shape[-1])
    initial = np.zeros(len(letters) * N_SPEEDS**2)
    initial[starts * N_SPEEDS**2] = summing_to_one(np.full(len(starts), 1 / len(starts)))
    return TransitionModel(
        prob=summing_to_one(prob).reshape(rest),
        next_state=next_state.reshape(rest),
        reward=np.full(shape, step_reward).reshape(rest),
        terminated=terminated.reshape(rest),
        initial=initial,
    )
