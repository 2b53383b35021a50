"""Tile coding, and sums of weights of active tiles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.agents.common.masks import numbers_in
from rl_yardstick.agents.common.settings import FINITE, whole
from rl_yardstick.agents.compiled.env_states import BEFORE, observe
from rl_yardstick.agents.compiled.loop import CompiledOnlyError, by_type
from rl_yardstick.agents.compiled.worlds import UNDECIDED
from rl_yardstick.machine_code.compiling import called, kernel
from rl_yardstick.mdp.transition_model import Floats, Ints

# Tile coding: an observation has one active tile in each of several tilings.
#
# A tiling cuts the space between ``low`` and ``high`` into tiles of equal width. Tiling t of n is
# displaced by (1, 3, 5, ...) t / n tiles, a different share in each dimension, modulo one tile. To
# cover the space, displaced tilings have one more tile in each dimension. Tiles are numbered;
# nothing is hashed. A state of a table is a dimension with one tiling of tiles of width 1.
#
# Source: Sutton and Barto (2nd edition), section 9.5.4.

# The tiles along a dimension; one array compiles faster than four.
DIMENSION = np.dtype(
    [
        ("low", np.float64),  # where tiles begin
        ("steps", np.float64),  # steps (of 1/n tile each) per unit of the observation
        ("n_steps", np.int64),  # steps between low and high
        ("stride", np.int64),  # difference of the numbers of neighbouring tiles
    ],
    align=True,
)


class Tiles(NamedTuple):
    """Tilings of a space of d dimensions."""

    dimensions: NDArray[np.void]  # records of type `DIMENSION`, shape (d,)
    n_tilings: int  # number n of tilings
    n_in_tiling: int  # number of tiles in each tiling

    @property
    def n_tiles(self) -> int:
        """Number of tiles in all tilings."""
        return self.n_tilings * self.n_in_tiling


@called
def active_tiles(tiles: Tiles, vector: Floats, active: Ints) -> None:
    """Fill in the active tile of each tiling for a vector.

    Values outside the bounds count as lying on the bound, and nan as the lower bound.
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
    """The tilings of a space from ``low`` on, with ``counts`` tiles in each dimension."""
    # Displaced tilings need one more tile to cover the space.
    sizes = [int(count) + (n_tilings > 1) for count in counts]
    dimensions = np.zeros(len(sizes), dtype=DIMENSION)
    dimensions["low"] = low
    dimensions["steps"] = tiles_per_unit * n_tilings
    dimensions["n_steps"] = counts * n_tilings
    dimensions["stride"] = [math.prod(sizes[d + 1 :]) for d in range(len(sizes))]
    return Tiles(dimensions, n_tilings, math.prod(sizes))


# Tilings from settings, which are checked, and observations as vectors.

# Eight bytes each.
MOST_WEIGHTS = 20_000_000
# Environments without bounds have infinity or the largest number as a bound.
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
        space: `Box` of shape (d,); or `Discrete`, where each number is a tile, whatever the other
            arguments are.
        n_tilings: number of tilings.
        n_tiles: tiles between low and high, one number or one for each dimension.
        low: where tiles begin, one number or one for each dimension; None for the space's bound.
        high: where they end, likewise.
        n_actions: weights of each tile.

    Raises:
        ValueError: if a bound is missing or out of order, a number is no integer or too small, or
            there would be too many weights.
    """
    if isinstance(space, spaces.Discrete):
        return tiles_between(np.zeros(1), np.ones(1), np.array([int(space.n)]), 1)
    assert isinstance(space, spaces.Box)
    (n_dims,) = space.shape
    whole(1).check("n_tilings", n_tilings)
    counts = _for_each("n_tiles", n_tiles, np.ones(n_dims))
    for count in counts:
        whole(1).check("n_tiles", int(count) if count == int(count) else count)
    lows, highs = _for_each("low", low, space.low), _for_each("high", high, space.high)
    for d, (lower, upper) in enumerate(zip(lows, highs, strict=True)):
        if not (abs(lower) < UNBOUNDED and abs(upper) < UNBOUNDED):
            raise ValueError(
                f"dimension {d} of the observations has no bounds: give low and high, a number or "
                f"{n_dims} of them (null for the space's own bound)"
            )
        if not lower < upper:
            raise ValueError(f"low must be below high, not {lower:g} and {upper:g} (dimension {d})")
    n_weights = n_actions * n_tilings * math.prod(int(n) + (n_tilings > 1) for n in counts)
    if n_weights > MOST_WEIGHTS:
        raise ValueError(
            f"n_tilings {n_tilings} and n_tiles {n_tiles} make {n_weights:,} weights for "
            f"{n_actions} actions, more than {MOST_WEIGHTS:,}: lower them"
        )
    return tiles_between(lows, counts / (highs - lows), counts.astype(np.int64), int(n_tilings))


def _for_each(name: str, given: Any, of_space: NDArray[Any]) -> Floats:
    """A number for each dimension, the space's own where none is given."""
    n_dims = len(of_space)
    values = list(given) if isinstance(given, list | tuple | np.ndarray) else [given] * n_dims
    if len(values) != n_dims:
        raise ValueError(f"{name} must be a number or {n_dims} numbers, not {given}")
    for value in values:
        FINITE.check(name, value)
    own = of_space.tolist()
    return np.array([b if a is None else a for a, b in zip(values, own, strict=True)], np.float64)


def vectors_of(space: spaces.Space[Any], observations: Any) -> Floats:
    """Observations as vectors for `Tiles`, shape (n, d); a `Box` in single precision."""
    given = np.asarray(observations)
    if not isinstance(space, spaces.Discrete):
        assert space.shape is not None
        return given.reshape(-1, *space.shape).astype(np.float32).astype(np.float64)
    return numbers_in(space, given).reshape(-1, 1).astype(np.float64)


# Agents whose values or preferences are sums of weights: one for each active tile and action.
#
# Compiled functions, shared by the interpreted and the compiled training loop. An algorithm defines
# how to choose by the sums, and how to learn. Step sizes are divided by the number of tilings, so
# that a step size of 1 moves a sum all the way to its target.
#
# Source: Sutton and Barto (2nd edition), sections 9.4 and 9.5.4.


class Room(NamedTuple):
    """Scratch arrays, without meaning between two calls."""

    vector: Floats  # an observation, shape (d,)
    tiles: Ints  # the active tiles of an observation, shape (n_tilings,)
    next_tiles: Ints  # those of the next one, likewise
    sums: Floats  # a number for each action, shape (A,)


class LinearAgent(NamedTuple):
    """An agent for compiled functions."""

    settings: Any  # a record of its class's type
    # Of action values or preferences, in the memory of its policy, shape (tiles, A).
    weights: Floats
    memory: Any  # further state; each algorithm has its own type
    tiles: Tiles  # how observations become tiles
    seen: Any  # how observations are read from the environments' records
    room: Room  # scratch arrays
    rng: Any  # a handle of its generator


class HandedVectors(NamedTuple):
    """Observations that the interpreted loop passes, by the number of the environment."""

    before: Floats  # the observations before the step, shape (n, d)
    after: Floats  # those after it, before any reset, shape (n, d)

    @called
    def observe(self, env: Any, moment: int, row: Any) -> None:
        """The vector of that moment, shape (d,)."""
        for j in range(len(row)):
            row[j] = self.before[env.number, j] if moment == BEFORE else self.after[env.number, j]

    @called
    def move_on(self, env: Any) -> None:
        """Do nothing: the interpreted loop moves on by itself."""


@by_type
def choose_by_sums(agent: LinearAgent, progress: Any) -> int:
    """An action by ``agent.room.sums``."""
    raise CompiledOnlyError


@called
def look(agent: LinearAgent, env: Any, moment: int, tiles: Ints) -> None:
    """Fill in the tiles that are active at this moment of the environment's last step."""
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
def add_up(agent: LinearAgent, tiles: Ints) -> None:
    """Fill ``agent.room.sums`` with the sum of each action's weights over the tiles."""
    sums = agent.room.sums
    for action in range(len(sums)):
        sums[action] = sum_of(agent.weights, tiles, action)


@called
def choose(agent: LinearAgent, tiles: Ints, progress: Any) -> int:
    """Choose an action in a state with these active tiles."""
    add_up(agent, tiles)
    return choose_by_sums(agent, progress)


@called
def act_on_tiles(agent: LinearAgent, env: Any, progress: Any) -> None:
    """Take the action that the agent has committed to, or choose one."""
    env.action = env.next_action
    env.next_action = UNDECIDED
    if env.action == UNDECIDED:
        look(agent, env, BEFORE, agent.room.tiles)
        env.action = choose(agent, agent.room.tiles, progress)
