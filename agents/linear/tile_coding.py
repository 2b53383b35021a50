"""Tile coding: an observation as the tiles that it lies in, one of each of several tilings.

A tiling cuts the space between ``low`` and ``high`` into tiles of equal width. Another one is
displaced by a share of a tile that differs between the dimensions: tiling t by (1, 3, 5, ...) t / n
tiles, where n tilings there are, and whole tiles left out. To cover the space all the same it has a
tile more in each dimension. Tiles are numbered; nothing is hashed. A number that stands for itself,
as a state of a table, is a dimension with one tiling of tiles of width 1.

Source: Sutton and Barto (2nd edition), section 9.5.4.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from machine_code.compiling import called, kernel
from mdp.array_types import Floats, Ints

# How tiles lie along a dimension; one array is compiled sooner than four.
DIMENSION = np.dtype(
    [
        ("low", np.float64),  # where tiles begin
        ("steps", np.float64),  # steps of one n-th of a tile in a unit of the observation
        ("n_steps", np.int64),  # such steps between low and high
        ("stride", np.int64),  # by how much a tile's number grows from one to the next
    ],
    align=True,
)


class Tiles(NamedTuple):
    """Tilings of a space of d dimensions.

    Attributes:
        dimensions: records of type `DIMENSION`, shape (d,).
        n_tilings: number n of tilings.
        n_in_tiling: tiles of each of them.
    """

    dimensions: NDArray[np.void]
    n_tilings: int
    n_in_tiling: int

    @property
    def n_tiles(self) -> int:
        """Tiles of all tilings."""
        return self.n_tilings * self.n_in_tiling


@called
def active_tiles(tiles: Tiles, vector: Floats, active: Ints) -> None:
    """Fill in the tile of each tiling that a vector lies in.

    What lies outside of the bounds, or is no number, counts as lying on them.

    Args:
        tiles: the tilings.
        vector: the observation, shape (d,).
        active: the tiles' numbers, shape (n_tilings,).
    """
    for tiling in range(len(active)):
        active[tiling] = tiling * tiles.n_in_tiling
    for d in range(len(vector)):
        along = tiles.dimensions[d]
        place = (vector[d] - along.low) * along.steps
        step = 0
        if place > 0.0:
            step = int(min(place, along.n_steps - 1.0))
        for tiling in range(len(active)):
            displacement = tiling * (2 * d + 1) % tiles.n_tilings
            active[tiling] += (step + displacement) // tiles.n_tilings * along.stride


@kernel
def active_tiles_of_all(tiles: Tiles, vectors: Floats, active: Ints) -> None:
    """`active_tiles` of n vectors, shapes (n, d) and (n, n_tilings)."""
    for i in range(len(vectors)):
        active_tiles(tiles, vectors[i], active[i])


def tiles_of_all(tiles: Tiles, vectors: Floats) -> Ints:
    """The active tiles of n vectors of shape (n, d), shape (n, n_tilings)."""
    active = np.empty((len(vectors), tiles.n_tilings), dtype=np.int64)
    active_tiles_of_all(tiles, vectors, active)
    return active


def tiles_between(low: Floats, tiles_per_unit: Floats, counts: Ints, n_tilings: int) -> Tiles:
    """Tilings of a space.

    Args:
        low: where tiles begin, shape (d,).
        tiles_per_unit: tiles in a unit of the observation, shape (d,).
        counts: tiles from low to high, shape (d,).
        n_tilings: number of tilings.
    """
    # What is displaced covers the space with a tile more.
    sizes = [int(count) + (n_tilings > 1) for count in counts]
    dimensions = np.zeros(len(sizes), dtype=DIMENSION)
    dimensions["low"] = low
    dimensions["steps"] = tiles_per_unit * n_tilings
    dimensions["n_steps"] = counts * n_tilings
    dimensions["stride"] = [math.prod(sizes[d + 1 :]) for d in range(len(sizes))]
    return Tiles(dimensions, n_tilings, math.prod(sizes))
