"""Random maps: solvable, reproducible, and as asked for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from envs.warehouse import WarehouseEnv, random_warehouse


def shelves(rows: list[str]) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    return np.array([[letter == "#" for letter in row] for row in rows])


@given(st.integers(2, 12), st.floats(0, 1), st.integers(0, 2**63 - 1))
def test_every_map_can_be_solved_between_opposite_corners(
    size: int, density: float, seed: int
) -> None:
    rows = random_warehouse(size, density, seed)
    assert [len(row) for row in rows] == [size] * size
    assert (rows[-1][0], rows[0][-1]) == ("S", "G")
    assert WarehouseEnv(desc=rows).shortest_path_length >= 2 * (size - 1)


@given(st.integers(2, 9), st.floats(0.3, 1), st.integers(0, 2**32))
def test_no_more_shelves_are_taken_out_than_needed(size: int, density: float, seed: int) -> None:
    """The generator's first numbers give the map before; Dijkstra on it the fewest shelves."""
    rows = random_warehouse(size, density, seed)
    before = np.random.default_rng(seed).random((size, size)) < density
    before[-1, 0] = before[0, -1] = False
    row, column = np.divmod(np.arange(size * size), size)
    beside = abs(row[:, None] - row) + abs(column[:, None] - column) == 1
    # Graphs hold no edges of weight zero; so many small ones do not add up to one shelf.
    entering = np.where(before.ravel(), 1.0, 1e-6)
    cost = dijkstra(csr_array(beside * entering), indices=size * (size - 1))[size - 1]
    after = shelves(rows)
    assert not np.any(after & ~before)
    assert np.count_nonzero(before & ~after) == int(cost)


def test_the_same_seed_gives_the_same_map_and_another_one_another() -> None:
    assert random_warehouse(10, 0.3, 0) == random_warehouse(10, 0.3, 0)
    assert len({tuple(random_warehouse(10, 0.3, seed)) for seed in range(20)}) == 20


def test_this_map_stays_as_it_is() -> None:
    """Results on RandomWarehouse-v0 name the map by its seed alone."""
    assert random_warehouse(6, 0.4, 7) == [
        "...##G",
        "#...#.",
        "#.....",
        "..##.#",
        "......",
        "S###.#",
    ]


def test_the_density_is_as_asked_for() -> None:
    """A million cells at 0.3 have a standard deviation of 0.00046."""
    assert abs(shelves(random_warehouse(1000, 0.3, 5)).mean() - 0.3) < 0.002


@pytest.mark.parametrize("density", [0, 1])
def test_the_ends_of_the_density(density: float) -> None:
    n_shelves = np.count_nonzero(shelves(random_warehouse(6, density)))
    # A full warehouse keeps all but one shortest way of eleven cells.
    assert n_shelves == (0 if density == 0 else 36 - 11)


@pytest.mark.parametrize(
    ("size", "density", "seed", "message"),
    [
        (1, 0.3, 0, "size must be a whole number from 2 to 4096, not 1"),
        (5000, 0.3, 0, "size must be a whole number from 2 to 4096, not 5000"),
        (2.5, 0.3, 0, "size must be a whole number from 2 to 4096, not 2.5"),
        (5, 1.1, 0, "shelf_density must be a finite number from 0 to 1, not 1.1"),
        (5, 0.3, -1, "map_seed must be a whole number from 0 to 9223372036854775807, not -1"),
        (5, 0.3, True, "map_seed must be a whole number from 0 to 9223372036854775807, not True"),
    ],
)
def test_arguments_out_of_range_are_refused(
    size: int, density: float, seed: int, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        random_warehouse(size, density, seed)
