"""Random maps that can be solved."""

from __future__ import annotations

from array import array
from functools import lru_cache

import numpy as np

from envs.argument_checks import check_number, check_whole_number
from envs.grid_map import MAX_STATES
from mdp.array_types import Bools

MAX_SIZE = int(MAX_STATES**0.5)


def random_warehouse(size: int, shelf_density: float = 0.3, seed: int = 0) -> list[str]:
    """A square map for Warehouse-v0 with shelves at random.

    The start is in the lower left corner and the goal in the upper right one. Where shelves cut
    them off from each other, the fewest that make a way are taken out.

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
    """The cells of a way that passes the fewest cells that are not free.

    A breadth-first search that first goes wherever it can without entering a shelf, then enters
    those it has met, goes on from there, and so forth. The border of the map stays closed.
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
        # It grows while it is gone through: a queue that nothing is taken out of.
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
