"""Tile coding against examples worked out by hand, and what must hold of any."""

import math

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from agents.linear.tiles import MOST_WEIGHTS, make_tiles, tiles_of_all, vectors_of

UNIT = spaces.Box(0.0, 1.0, (2,))


def active(tiles, *vectors):
    return tiles_of_all(tiles, np.array(vectors, dtype=np.float64)).tolist()


def test_two_tilings_of_a_square_by_hand():
    """Two tilings of 4 x 4 tiles: the second is displaced by half a tile in both directions.

    It has five tiles a side, as has the first, which leaves its last row and column empty. At
    (0.3, 0.6) the first is in tile (1, 2), which is 1 * 5 + 2; the second, whose tiles begin an
    eighth earlier, at (0.425, 0.725): the same tile, 25 further. At (0.4, 0.6) it is in (2, 2).
    """
    tiles = make_tiles(UNIT, n_tilings=2, n_tiles=4)
    assert (tiles.n_tilings, tiles.n_in_tiling, tiles.n_tiles) == (2, 25, 50)
    assert active(tiles, (0.3, 0.6)) == [[7, 32]]
    assert active(tiles, (0.4, 0.6)) == [[7, 25 + 2 * 5 + 2]]
    assert active(tiles, (0.0, 0.0), (1.0, 1.0)) == [[0, 25], [18, 25 + 24]]


def test_four_tilings_of_a_line_by_hand():
    """Tiles of width 1 from 0 to 3, displaced by quarters: the tiles change once a quarter."""
    tiles = make_tiles(spaces.Box(0.0, 3.0, (1,)), n_tilings=4, n_tiles=3)
    places = [0.1, 0.3, 0.6, 0.9, 1.1]
    in_tiling = np.array(active(tiles, *([place] for place in places))) - 4 * np.arange(4)
    expected = [[0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 1, 1], [0, 1, 1, 1], [1, 1, 1, 1]]
    assert in_tiling.tolist() == expected


def test_displacements_are_odd_multiples():
    """Of eight tilings, the second is displaced by 1, 3 and 5 eighths in three dimensions.

    So the first place where it enters its next tile lies 7, 5 and 3 eighths of a tile from low.
    """
    tiles = make_tiles(spaces.Box(0.0, 1.0, (3,)), n_tilings=8, n_tiles=1)
    for d, eighths in enumerate((7, 5, 3)):
        before, after = np.zeros(3), np.zeros(3)
        before[d], after[d] = eighths / 8 - 1e-9, eighths / 8
        (first, second) = active(tiles, before, after)
        assert first[1] == active(tiles, np.zeros(3))[0][1]
        assert second[1] - first[1] == 2 ** (2 - d)


@pytest.mark.parametrize("n", [1, 7, 49, 1000])
def test_each_number_of_a_discrete_space_is_a_tile_of_its_own(n):
    space = spaces.Discrete(n)
    tiles = make_tiles(space, n_tilings=8, n_tiles=3)
    assert (tiles.n_tilings, tiles.n_tiles) == (1, n)
    assert active(tiles, *vectors_of(space, np.arange(n))) == [[i] for i in range(n)]


TILINGS = st.fixed_dictionaries(
    {
        "n_tilings": st.integers(1, 16),
        "n_tiles": st.lists(st.integers(1, 9), min_size=2, max_size=2),
    }
)
BOUNDS = spaces.Box(np.array([-1.2, -0.07], "f4"), np.array([0.6, 0.07], "f4"))
PLACES = st.tuples(st.floats(-2, 2, width=32), st.floats(-0.125, 0.125, width=32))


@given(TILINGS, PLACES)
def test_one_tile_of_each_tiling_is_active(settings, place):
    tiles = make_tiles(BOUNDS, **settings)
    (found,) = active(tiles, place)
    assert [tile // tiles.n_in_tiling for tile in found] == list(range(settings["n_tilings"]))
    assert max(found) < tiles.n_tiles


@given(TILINGS, PLACES, PLACES)
def test_places_share_as_many_tiles_as_the_displacements_say(settings, first, second):
    """In rationals: tiling t has an edge every tile, displaced by (2 d + 1) t / n tiles."""
    tiles = make_tiles(BOUNDS, **settings)
    n, shared = settings["n_tilings"], 0
    for t in range(n):
        cells = []
        for place in (first, second):
            steps = [
                min(max(math.floor((x - low) * per_unit), 0), count * n - 1)
                for x, low, per_unit, count in zip(
                    place,
                    BOUNDS.low.astype(float),
                    tiles.dimensions["steps"],
                    settings["n_tiles"],
                    strict=True,
                )
            ]
            cells.append([(step + t * (2 * d + 1) % n) // n for d, step in enumerate(steps)])
        shared += cells[0] == cells[1]
    one, other = active(tiles, first, second)
    assert len(set(one) & set(other)) == shared


@given(TILINGS, st.floats(0, 1), st.floats(-1, 1))
def test_places_less_than_a_tile_apart_share_tiles_in_proportion(settings, place, shift):
    """Along one dimension, k n-ths of a tile away, all but k of the n tilings agree, or k + 1."""
    n, (count, _) = settings["n_tilings"], settings["n_tiles"]
    tiles = make_tiles(spaces.Box(0.0, 1.0, (1,)), n_tilings=n, n_tiles=count)
    other = min(max(place + shift / count, 0.0), 1.0)
    one, two = active(tiles, [place], [other])
    apart = abs(other - place) * count * n
    assert n - apart - 1 <= len(set(one) & set(two)) + 1e-9
    assert len(set(one) & set(two)) <= max(n - apart + 1, 0) + 1e-9


def test_bounds_belong_to_the_space_and_what_lies_outside_to_the_bounds():
    tiles = make_tiles(BOUNDS, n_tilings=8, n_tiles=8)
    low, high = BOUNDS.low.astype(float), BOUNDS.high.astype(float)
    nearly = high - 1e-9
    assert active(tiles, high, high + 5, np.full(2, np.inf)) == 3 * active(tiles, nearly)
    assert active(tiles, low, low - 5, np.full(2, -np.inf), np.full(2, np.nan)) == 4 * active(
        tiles, low
    )
    assert set(active(tiles, low)[0]).isdisjoint(active(tiles, high)[0])


def test_observations_count_in_single_precision():
    space = spaces.Box(-1.0, 1.0, (2,), dtype=np.float64)
    assert vectors_of(space, [0.1, 0.2]).tolist() == [
        [float(np.float32(0.1)), float(np.float32(0.2))]
    ]
    with pytest.raises(ValueError, match=r"observation 5 is not in Discrete\(5\), the agent's sp"):
        vectors_of(spaces.Discrete(5), np.array([0, 5]))


UNBOUNDED = spaces.Box(np.array([-4.8, -np.inf], "f4"), np.array([4.8, np.inf], "f4"))


def test_bounds_are_the_spaces_own_unless_given():
    given = make_tiles(UNBOUNDED, low=[None, -3], high=[None, 3])
    assert given.dimensions["low"].tolist() == [float(np.float32(-4.8)), -3.0]
    assert given.dimensions["n_steps"].tolist() == [64, 64]
    assert given.dimensions["steps"].tolist() == [64 / (2 * float(np.float32(4.8))), 64 / 6]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "dimension 1 of the observations has no bounds: give low and high, a number or 2 of"),
        ({"low": -1}, "dimension 1 of the observations has no bounds: give low and high"),
        ({"low": -1, "high": [1, 2, 3]}, r"high must be a number or 2 numbers, not \[1, 2, 3\]"),
        ({"low": 1, "high": [2, 1]}, r"low must be below high, not 1 and 1 \(dimension 1\)"),
        ({"low": "a", "high": 1}, "low must be finite numbers, not 'a'"),
        ({"low": math.nan, "high": 1}, "low must be finite numbers, not nan"),
        ({"low": True, "high": 1}, "low must be finite numbers, not True"),
        ({"low": -1, "high": 1, "n_tiles": 0}, "n_tiles must be from 1 to 20,000,000, not 0"),
        ({"low": -1, "high": 1, "n_tiles": [8]}, r"n_tiles must be a number or 2 numbers"),
        ({"low": -1, "high": 1, "n_tilings": 2.5}, "n_tilings must be whole numbers, not 2.5"),
        ({"low": -1, "high": 1, "n_tilings": [4]}, r"n_tilings must be whole numbers, not \[4\]"),
        ({"low": -1, "high": 1, "n_tilings": True}, "n_tilings must be whole numbers, not True"),
        ({"low": -1, "high": 1, "n_tiles": 3000}, r"make 216,144,024 weights for 3 actions, more"),
        ({"low": -1, "high": 1, "n_tiles": 10**9}, f"n_tiles must be from 1 to {MOST_WEIGHTS:,}"),
    ],
)
def test_settings_that_make_no_tiling(settings, message):
    with pytest.raises(ValueError, match=message):
        make_tiles(UNBOUNDED, **settings, n_actions=3)
