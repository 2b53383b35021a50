"""What settings say of tile coding, checked, and observations as it reads them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from agents.common.observed_numbers import numbers_in
from agents.linear.tile_coding import Tiles, tiles_between
from mdp.array_types import Floats, Ints

# Eight bytes each.
MOST_WEIGHTS = 20_000_000
# Environments say that there is no bound by infinity, or by the largest number there is.
UNBOUNDED = float(np.finfo(np.float32).max)

Bound = float | Sequence[float | None] | None


def make_tiles(
    space: spaces.Space[Any],
    n_tilings: int = 8,
    n_tiles: int | Sequence[int] = 8,
    low: Bound = None,
    high: Bound = None,
    n_actions: int = 1,
) -> Tiles:
    """The tilings of an observation space.

    Args:
        space: `Box` of shape (d,); or `Discrete`, each number of which is a tile, whatever the
            other arguments are.
        n_tilings: number of tilings.
        n_tiles: tiles between low and high, for all dimensions or for each.
        low: where tiles begin, likewise; None for the space's own bound.
        high: where they end, likewise.
        n_actions: weights that each tile is to have.

    Raises:
        ValueError: if a bound is missing or out of order, a number is not whole or too small, or
            there would be too many weights.
    """
    if isinstance(space, spaces.Discrete):
        return tiles_between(np.zeros(1), np.ones(1), np.array([int(space.n)]), 1)
    assert isinstance(space, spaces.Box)
    (n_dims,) = space.shape
    tilings = _whole_number("n_tilings", n_tilings)
    given = _for_each("n_tiles", n_tiles, n_dims)
    counts = np.array([_whole_number("n_tiles", count) for count in given], dtype=np.int64)
    lows = _bounds("low", low, space.low)
    highs = _bounds("high", high, space.high)
    for d, (lower, upper) in enumerate(zip(lows, highs, strict=True)):
        if not lower < upper:
            raise ValueError(f"low must be below high, not {lower:g} and {upper:g} (dimension {d})")
    _check_size(counts, tilings, n_actions)
    return tiles_between(lows, counts / (highs - lows), counts, tilings)


def vectors_of(space: spaces.Space[Any], observations: Any) -> Floats:
    """Observations as `Tiles` read them, those of a `Box` in single precision.

    Returns:
        Vectors, shape (n, d).

    Raises:
        ValueError: if a number is not in a `Discrete` space.
    """
    given = np.asarray(observations)
    if not isinstance(space, spaces.Discrete):
        assert space.shape is not None
        return given.reshape(-1, *space.shape).astype(np.float32).astype(np.float64)
    return numbers_in(space, given).reshape(-1, 1).astype(np.float64)


def _check_size(counts: Ints, n_tilings: int, n_actions: int) -> None:
    n_weights = math.prod(int(count) + (n_tilings > 1) for count in counts) * n_tilings * n_actions
    if n_weights > MOST_WEIGHTS:
        raise ValueError(
            f"n_tilings {n_tilings} and n_tiles {counts.tolist()} make {n_weights:,} weights for "
            f"{n_actions} actions, more than {MOST_WEIGHTS:,}: lower them"
        )


def _bounds(name: str, given: Any, of_space: NDArray[Any]) -> Floats:
    """A bound for each dimension, the space's own where none is given."""
    values = _for_each(name, given, len(of_space))
    for d, value in enumerate(values):
        if value is None:
            if not abs(float(of_space[d])) < UNBOUNDED:
                raise ValueError(
                    f"dimension {d} of the observations has no bounds: give low and high, a number "
                    f"or {len(of_space)} of them (null for the space's own bound)"
                )
            values[d] = float(of_space[d])
        elif not _is_number(value):
            raise ValueError(f"{name} must be finite numbers, not {value!r}")
    return np.array(values, dtype=np.float64)


def _for_each(name: str, given: Any, n: int) -> list[Any]:
    """A value for each of n dimensions."""
    values = list(given) if isinstance(given, list | tuple | np.ndarray) else [given] * n
    if len(values) != n:
        raise ValueError(f"{name} must be a number or {n} numbers, not {given}")
    return values


def _is_number(value: Any) -> bool:
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return is_number and math.isfinite(value)


def _whole_number(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"{name} must be whole numbers, not {value!r}")
    if not 1 <= value <= MOST_WEIGHTS:
        raise ValueError(f"{name} must be from 1 to {MOST_WEIGHTS:,}, not {value:,}")
    return int(value)
