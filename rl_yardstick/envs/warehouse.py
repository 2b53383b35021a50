"""Warehouses to find a way through, on given maps or on random ones that can be solved."""

from __future__ import annotations

from array import array
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.envs.argument_checks import check_choice, check_number, check_whole_number
from rl_yardstick.envs.grid import MAX_STATES, MOVES, Description, GridWorld, Tile
from rl_yardstick.mdp.transition_model import AnyInts, Bools

MAX_SIZE = int(MAX_STATES**0.5)


def random_warehouse(size: int, shelf_density: float = 0.3, seed: int = 0) -> list[str]:
    """A square map for Warehouse-v0 with shelves at random.

    The start is in the lower left corner and the goal in the upper right one. Where shelves cut
    them off from each other, the smallest number of shelves that opens a way is removed.

    Args:
        size: number of rows and of columns.
        shelf_density: probability of each cell to hold a shelf.
        seed: the same arguments give the same map.

    Returns:
        The rows of the map.

    Raises:
        ValueError: if the size is not from 2 to 4096, the density not from 0 to 1, or the seed
            negative.
    """
    check_whole_number("size", size, 2, MAX_SIZE)
    check_whole_number("map_seed", seed, 0, 2**63 - 1)
    check_number("shelf_density", shelf_density, 0, 1)
    return list(_rows(int(size), float(shelf_density), int(seed)))


@lru_cache(maxsize=4)  # a run makes its environment several times, and a large map takes a second
def _rows(size: int, shelf_density: float, seed: int) -> tuple[str, ...]:
    free = np.random.default_rng(seed).random((size, size)) >= shelf_density
    free[-1, 0] = free[0, -1] = True
    width = size + 2
    padded = np.pad(free, 1)
    start, goal = size * width + 1, width + size
    for cell in _easiest_way(padded, start, goal):
        padded.flat[cell] = True
    letters = np.where(padded[1:-1, 1:-1], b".", b"#")
    letters[-1, 0], letters[0, -1] = b"S", b"G"
    return tuple(row.tobytes().decode("ascii") for row in letters)


def _easiest_way(free: Bools, start: int, goal: int) -> list[int]:
    """The cells of a way with the fewest shelves.

    A breadth-first search that visits all cells it can reach without entering a shelf, then enters
    the shelves it has met, goes on from there, and so forth. The border of the map stays closed.
    """
    width = free.shape[1]
    is_free = free.tobytes()
    border = np.ones(free.shape, np.int32)
    border[1:-1, 1:-1] = -1
    came_from = array("i", border.tobytes())
    came_from[start] = start
    frontier = [start]
    while came_from[goal] < 0:
        shelves: list[int] = []
        # The loop appends to the list, which serves as a queue.
        for cell in frontier:
            for beside in (cell - width, cell + 1, cell - 1, cell + width):
                if came_from[beside] < 0:
                    came_from[beside] = cell
                    (frontier if is_free[beside] else shelves).append(beside)
        frontier = shelves
    way = [goal]
    while way[-1] != start:
        way.append(came_from[way[-1]])
    return way


DEFAULT_MAP = (
    "...#.....G",
    ".###.####.",
    ".....#....",
    "###.#..###",
    "..#.#.##..",
    "....#.....",
    "###.###.##",
    "..#......#",
    ".####.###.",
    "S.........",
)
OBSERVATIONS = ("discrete", "position", "one_hot", "neighbours")


class WarehouseEnv(GridWorld):
    """A robot finds the shortest way through a warehouse without running into its shelves.

    ## Description
    The robot starts in one corner of a warehouse and is to reach the loading point in the other.
    In between stand shelves, among which there are dead ends. The default map, with shelves
    ``#``, aisles ``.``, the start ``S`` and the goal ``G``::

        ...#.....G
        .###.####.
        .....#....
        ###.#..###
        ..#.#.##..
        ....#.....
        ###.###.##
        ..#......#
        .####.###.
        S.........

    The shortest way takes 22 moves; there are two of that length.

    ## Action Space
    `Discrete(4)`: 0 up, 1 down, 2 left, 3 right.

    ## Observation Space
    With `observation="discrete"`, `Discrete(rows * columns)`: row times the number of columns plus
    column, row 0 being at the top. With `"position"`, `Box(0, 1, (2,), float32)`: row and column,
    each divided by its largest value. With `"one_hot"`, `Box(0, 1, (rows * columns,), float32)`: 1
    at the robot's cell and 0 elsewhere. With `"neighbours"`, `Discrete(81)`: a number of four
    digits in base 3, for the cells above, below, to the left and to the right: 0 an aisle, 1 a
    shelf or the outer wall, 2 the goal. It does not tell where the robot is.

    ## Rewards
    - a move, also one against the outer wall, where the robot stays: -1
    - a move against a shelf, where it stays too: -100
    - the move onto the goal: +100

    The best return on the default map is 21 * (-1) + 100 = 79.

    ## Starting State
    The cell marked `S`; with `random_start=True` any cell but the goal from which the goal can be
    reached, all with equal probability.

    ## Episode End
    The episode terminates on the goal. It is truncated after 1000 steps when made by
    `gymnasium.make`.

    ## Information
    `reset` and `step` give `position` (row, column), `bumped` (whether the robot ran into a shelf
    or the outer wall) and `is_success` (whether it stands on the goal).
    `action_masks()` tells which moves do not run into a shelf or the outer wall; with `slip` it
    considers the intended move, and in a cell that is walled in it allows all.
    States of the model are numbered as the discrete observation is, whatever is observed.

    ## Arguments
    - `desc`: the map, as a list of rows or the path to a text file with one row per line
    - `shelf_reward=-100`, `step_reward=-1`, `goal_reward=100`: the rewards
    - `slip=0`: probability that the robot moves sideways instead, half of it to each side
    - `random_start=False`: see Starting State
    - `observation="discrete"`: see Observation Space
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    def __init__(
        self,
        desc: Description = DEFAULT_MAP,
        shelf_reward: float = -100,
        step_reward: float = -1,
        goal_reward: float = 100,
        slip: float = 0,
        random_start: bool = False,
        observation: str = "discrete",
        render_mode: str | None = None,
    ) -> None:
        self.observation = check_choice("observation", observation, OBSERVATIONS)
        aisle = Tile(check_number("step_reward", step_reward))
        tiles = {
            "#": Tile(check_number("shelf_reward", shelf_reward), blocked=True),
            ".": aisle,
            "S": aisle,
            "G": Tile(check_number("goal_reward", goal_reward), terminated=True),
        }
        edge = replace(aisle, blocked=True)
        super().__init__(
            desc, tiles, edge, slip=slip, random_start=random_start, render_mode=render_mode
        )
        if observation == "position":
            self.observation_space = spaces.Box(0, 1, (2,), np.float32)
        elif observation == "one_hot":
            self.observation_space = spaces.Box(0, 1, (self.map.n_cells,), np.float32)
        elif observation == "neighbours":
            self.observation_space = spaces.Discrete(3 ** len(MOVES))

    def observation_of(self, states: AnyInts) -> NDArray[Any]:
        """The observations of many states: shape (n,), (n, 2) or (n, cells)."""
        if self.observation == "position":
            largest = np.maximum((self.map.n_rows - 1, self.map.n_columns - 1), 1)
            position = np.stack(np.divmod(states, self.map.n_columns), axis=-1)
            return (position / largest).astype(np.float32)
        if self.observation == "one_hot":
            hot = np.zeros((len(states), self.map.n_cells), np.float32)
            hot[np.arange(len(states)), states] = 1
            return hot
        return self._neighbours[states] if self.observation == "neighbours" else states

    @cached_property
    def _neighbours(self) -> NDArray[np.int64]:
        """What is beside each cell, as one number, shape (cells,)."""
        letters = np.frombuffer(self.map.codes, np.uint8)
        kinds = (letters == ord("#")) + 2 * (letters == ord("G"))
        kinds = np.pad(kinds.reshape(self.map.n_rows, -1), 1, constant_values=1)
        height, width = self.map.n_rows, self.map.n_columns
        beside = [kinds[1 + y : 1 + y + height, 1 + x : 1 + x + width] for y, x in MOVES]
        return np.ravel_multi_index(tuple(beside), (3,) * len(MOVES)).ravel()

    def _observe(self) -> int | NDArray[np.float32]:
        if self.observation == "discrete":
            return self.s
        observed: Any = self.observation_of(np.array([self.s]))[0]
        return int(observed) if self.observation == "neighbours" else observed


class RandomWarehouseEnv(WarehouseEnv):
    """A warehouse with shelves at random, of any size up to 4096 x 4096.

    ## Description
    A square map from `envs.warehouse.random_warehouse`: the start in the lower left corner, the
    goal in the upper right one, and always a way between them. Actions, observations, rewards and
    information are those of Warehouse-v0.

    ## Episode End
    The episode terminates on the goal. When made by `gymnasium.make`, it is truncated after ten
    times as many steps as the shortest way has, or after `max_episode_steps` where that is given.

    ## Arguments
    - `size=10`: number of rows and of columns
    - `shelf_density=0.3`: the approximate share of cells that hold a shelf
    - `map_seed=0`: the same seed gives the same map
    - all of Warehouse-v0's but `desc`
    """

    def __init__(
        self,
        size: int = 10,
        shelf_density: float = 0.3,
        map_seed: int = 0,
        shelf_reward: float = -100,
        step_reward: float = -1,
        goal_reward: float = 100,
        slip: float = 0,
        random_start: bool = False,
        observation: str = "discrete",
        render_mode: str | None = None,
    ) -> None:
        rows = random_warehouse(size, shelf_density, map_seed)
        given = shelf_reward, step_reward, goal_reward, slip, random_start, observation, render_mode
        super().__init__(rows, *given)
