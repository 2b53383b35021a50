"""Tile coding, and sums of weights of active tiles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from agents.common.masks import numbers_in
from agents.compiled.loop import CompiledOnlyError, act, by_type, learn_from_step
from agents.compiled.worlds import UNDECIDED
from agents.networks.network_worlds import BEFORE, observe
from machine_code.compiling import called, kernel
from mdp.transition_model import Floats, Ints

# Tile coding: an observation as the tiles that it lies in, one of each of several tilings.
#
# A tiling cuts the space between ``low`` and ``high`` into tiles of equal width. Another one is
# displaced by a share of a tile that differs between the dimensions: tiling t by (1, 3, 5, ...) t /
# n tiles, where n tilings there are, and whole tiles left out. To cover the space all the same it
# has a tile more in each dimension. Tiles are numbered; nothing is hashed. A number that stands for
# itself, as a state of a table, is a dimension with one tiling of tiles of width 1.
#
# Source: Sutton and Barto (2nd edition), section 9.5.4.

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
    """Tilings of a space of d dimensions."""

    dimensions: NDArray[np.void]  # records of type `DIMENSION`, shape (d,)
    n_tilings: int  # number n of tilings
    n_in_tiling: int  # tiles of each of them

    @property
    def n_tiles(self) -> int:
        """Tiles of all tilings."""
        return self.n_tilings * self.n_in_tiling


@called
def active_tiles(tiles: Tiles, vector: Floats, active: Ints) -> None:
    """Fill in the tile of each tiling that a vector lies in.

    What lies outside of the bounds, or is no number, counts as lying on them.
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
    """Tilings of a space."""
    # What is displaced covers the space with a tile more.
    sizes = [int(count) + (n_tilings > 1) for count in counts]
    dimensions = np.zeros(len(sizes), dtype=DIMENSION)
    dimensions["low"] = low
    dimensions["steps"] = tiles_per_unit * n_tilings
    dimensions["n_steps"] = counts * n_tilings
    dimensions["stride"] = [math.prod(sizes[d + 1 :]) for d in range(len(sizes))]
    return Tiles(dimensions, n_tilings, math.prod(sizes))


# What settings say of tile coding, checked, and observations as it reads them.

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
    """Observations as `Tiles` read them, those of a `Box` in single precision."""
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


# Agents whose values or preferences are sums of weights: one for each active tile and action.
#
# Compiled functions, shared by the interpreted and the compiled training loop. What an algorithm
# adds is how it chooses among the sums, and how it learns. Step sizes are divided by the number of
# tilings, so that a step size of 1 moves a sum all the way to its target.
#
# Source: Sutton and Barto (2nd edition), sections 9.4 and 9.5.4.


class Room(NamedTuple):
    """Where numbers are worked out; what it holds between two calls means nothing."""

    vector: Floats  # an observation, shape (d,)
    tiles: Ints  # the active tiles of an observation, shape (n_tilings,)
    next_tiles: Ints  # those of the next one, likewise
    sums: Floats  # a number for each action, shape (A,)


class LinearAgent(NamedTuple):
    """An agent as compiled functions see it."""

    settings: Any  # a record of the type that its class has
    # Of action values or preferences, in the memory of its policy, shape (tiles, A).
    weights: Floats
    memory: Any  # what else it keeps; each algorithm has a type of its own for that
    tiles: Tiles  # how observations become tiles
    seen: Any  # how observations are read from the environments' records
    room: Room  # for its work
    rng: Any  # a handle of its generator


class HandedVectors(NamedTuple):
    """Observations that the interpreted loop hands over, of environments that know their number."""

    before: Floats  # the observations before the step, shape (n, d)
    after: Floats  # those after it, before any reset, shape (n, d)

    @called
    def observe(self, env: Any, moment: int, row: Any) -> None:
        """The vector of that moment, shape (d,)."""
        for j in range(len(row)):
            row[j] = self.before[env.number, j] if moment == BEFORE else self.after[env.number, j]

    @called
    def move_on(self, env: Any) -> None:
        """The interpreted loop does that."""


@by_type
def choose_by_sums(agent: LinearAgent, progress: Any) -> int:
    """An action by ``agent.room.sums``."""
    raise CompiledOnlyError


@called
def look(agent: LinearAgent, env: Any, moment: int, tiles: Ints) -> None:
    """Fill in the tiles that are active at that moment of the environment's last step."""
    observe(agent.seen, env, moment, agent.room.vector)
    active_tiles(agent.tiles, agent.room.vector, tiles)


@called
def sum_of(weights: Floats, tiles: Ints, action: int) -> float:
    """The sum of an action's weights over the tiles."""
    total = 0.0
    for k in range(len(tiles)):
        total += weights[tiles[k], action]
    return total


@called
def move_sum(weights: Floats, tiles: Ints, action: int, step: float) -> None:
    """Move the sum of an action's weights over the tiles by a step."""
    for k in range(len(tiles)):
        weights[tiles[k], action] += step


@called
def add_up(agent: LinearAgent, tiles: Ints) -> None:
    """Fill ``agent.room.sums`` with the sum of each action's weights over the tiles."""
    sums = agent.room.sums
    for action in range(len(sums)):
        sums[action] = sum_of(agent.weights, tiles, action)


@called
def choose(agent: LinearAgent, tiles: Ints, progress: Any) -> int:
    """An action where these tiles are active."""
    add_up(agent, tiles)
    return choose_by_sums(agent, progress)


@called
def act_on_tiles(agent: LinearAgent, env: Any, progress: Any) -> None:
    """Do what was committed to, or choose."""
    env.action = env.next_action
    env.next_action = UNDECIDED
    if env.action == UNDECIDED:
        look(agent, env, BEFORE, agent.room.tiles)
        env.action = choose(agent, agent.room.tiles, progress)


@kernel
def act_in_all(agent: LinearAgent, envs: Any, progress: Any) -> None:
    """`act` in each environment, for the interpreted loop."""
    for i in range(len(envs)):
        act(agent, envs[i], progress)


@kernel
def learn_from_all(agent: LinearAgent, envs: Any, progress: Any) -> None:
    """`learn_from_step` of all environments, for the interpreted loop."""
    learn_from_step(agent, envs, progress)
