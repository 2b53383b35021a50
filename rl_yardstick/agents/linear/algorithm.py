"""Tile coding, and the base of the agents on active tiles: weights, policy, and training."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from rl_yardstick.agents.common.algorithm import Transitions
from rl_yardstick.agents.common.exploration import greedy_action
from rl_yardstick.agents.common.given_spaces import in_given_spaces
from rl_yardstick.agents.common.masks import numbers_in
from rl_yardstick.agents.common.model_files import TablePolicy
from rl_yardstick.agents.common.settings import (
    FINITE,
    SHARE,
    TieBreaking,
    check_space,
    check_vectors,
    whole,
)
from rl_yardstick.agents.compiled.engine import EngineChoice
from rl_yardstick.agents.compiled.env_states import BEFORE, observe
from rl_yardstick.agents.compiled.loop import by_type
from rl_yardstick.agents.compiled.references import handles_of
from rl_yardstick.agents.compiled.worlds import UNDECIDED, env_dtype
from rl_yardstick.agents.tabular.workspace import Workspace, WorkspaceAlgorithm
from rl_yardstick.machine_code.compiling import called, compiled
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


@compiled
def tiles_of_all(tiles: Tiles, vectors: Floats) -> Ints:
    """The active tiles of n vectors of shape (n, d), shape (n, n_tilings)."""
    active = np.empty((len(vectors), tiles.n_tilings), dtype=np.int64)
    for i in range(len(vectors)):
        active_tiles(tiles, vectors[i], active[i])
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
    values: Floats  # a number for each action, shape (A,)


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


@by_type
def choose_by_sums(agent: LinearAgent, progress: Any) -> int:
    """An action by ``agent.room.values``."""
    raise NotImplementedError


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
    """Fill ``agent.room.values`` with the sum of each action's weights over the tiles."""
    values = agent.room.values
    for action in range(len(values)):
        values[action] = sum_of(agent.weights, tiles, action)


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


class TilePolicy(TablePolicy):
    """Takes the action of the highest sum of weights over the active tiles."""

    weights: th.Tensor  # of action values or preferences, float64 of shape (tiles, A)
    state_weights: th.Tensor  # of state values, float64 of shape (tiles,), or (0,) without them
    sizes = ("tiling", "values_states")

    def __init__(
        self,
        *args: Any,
        tiling: dict[str, Any] | None = None,
        values_states: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.tiling, self.values_states = dict(tiling or {}), values_states
        n_actions = int(self.action_space.n)  # type: ignore[attr-defined]
        self.tiles = make_tiles(self.observation_space, **self.tiling, n_actions=n_actions)
        n_tiles = self.tiles.n_tiles
        self.register_buffer("weights", th.zeros((n_tiles, n_actions), dtype=th.float64))
        n_valued = n_tiles if values_states else 0
        self.register_buffer("state_weights", th.zeros(n_valued, dtype=th.float64))

    def sums(self, observations: NDArray[Any]) -> Floats:
        """Action values or preferences at n observations, shape (n, A)."""
        active = tiles_of_all(self.tiles, vectors_of(self.observation_space, observations))
        weights = self.weights.numpy()
        sums = np.zeros((len(active), weights.shape[1]))
        for tiles in active.T:  # in the order in which the training loops add up
            sums += weights[tiles]
        return sums

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        return th.from_numpy(self.sums(observation.numpy()).argmax(axis=1))


NUMBERED_ENV = env_dtype(("number", np.int64))


class TileWorkspace(Workspace):
    """A workspace of an agent on tiles."""

    def __init__(
        self, agent: LinearAgent, space: spaces.Space[Any], rng: np.random.Generator, n: int
    ) -> None:
        self.space = space
        before, after = np.zeros((2, n, len(agent.room.vector)))
        self.seen = HandedVectors(before, after)
        super().__init__(agent._replace(seen=self.seen), rng, n, NUMBERED_ENV)
        self.envs["number"] = np.arange(n)

    def act(self, observations: Any) -> Ints:
        """An action for each observation."""
        self.seen.before[:] = vectors_of(self.space, observations)
        return self.choose()

    def learn(self, transitions: Transitions) -> float:
        """Learn from a step of each environment, and return the mean absolute TD error."""
        self.seen.before[:] = vectors_of(self.space, transitions.obs)
        self.seen.after[:] = vectors_of(self.space, transitions.next_obs)
        self.fields["action"][:] = transitions.actions
        return self.learn_from(transitions)


class TilePlayer(NamedTuple):
    """Plays without learning: takes the first of the actions with the highest sum."""

    weights: Floats
    tiles: Tiles
    seen: Any
    room: Room

    @called
    def act(self: Any, env: Any, progress: Any) -> None:
        """Take the best action."""
        look(self, env, BEFORE, self.room.tiles)
        add_up(self, self.room.tiles)
        env.action = greedy_action(self.room.values, 0.0)


class TileAlgorithm(WorkspaceAlgorithm):
    """Learns weights of tiles: by tile coding, or as a table if observations are numbers.

    Args:
        policy: ``"TilePolicy"``.
        env: environment with `Discrete` actions, and observations in a `Box` of shape (d,), read in
            single precision, or in a `Discrete` space; or its id.
        learning_rate: step size, constant or scheduled. It is divided by the number of tilings, so
            that 1 moves a sum all the way to its target; the book's alpha is this quotient.
        tie_breaking: as in `LearningAlgorithm`.
        gamma: discount factor.
        n_tilings: number of tilings. This and the next three are for a `Box`; each number of a
            `Discrete` space is a tile of its own.
        n_tiles: tiles of each tiling in each dimension, a number or a list of d.
        low: where tiles begin, a number or a list of d; None for the space's own bound.
        high: where they end, likewise. Values outside count as lying on the bound.
        engine: as in `TabularAlgorithm`; environments with a known model, CartPole and MountainCar
            can be compiled.

    Raises:
        ValueError: if an argument is outside its range, a space does not fit, a dimension has no
            bounds, or there would be too many weights.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"TilePolicy": TilePolicy}
    policy: TilePolicy
    observed = ("Box", "Discrete")
    parameters = {"gamma": np.float64}  # noqa: RUF012
    ranges = {"gamma": SHARE}  # noqa: RUF012
    values_states: ClassVar[bool] = False
    hidden_arguments: ClassVar[tuple[str, ...]] = ("policy_kwargs",)

    act = act_on_tiles

    def __init__(
        self,
        policy: str | type[BasePolicy] = "TilePolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = 0.1,
        tie_breaking: TieBreaking = "random",
        gamma: float = 1.0,
        n_tilings: int = 8,
        n_tiles: int | Sequence[int] = 8,
        low: Bound = None,
        high: Bound = None,
        engine: EngineChoice = "auto",
        **kwargs: Any,
    ) -> None:
        self.gamma = gamma
        self.n_tilings = n_tilings
        self.n_tiles = n_tiles
        self.low = low
        self.high = high
        self.engine = engine
        super().__init__(policy, env, learning_rate, tie_breaking, **kwargs)

    def _check_arguments(self) -> None:
        check_space(self, "actions", self.action_space)
        check_vectors(self, self.observation_space)

    def _policy_arguments(self) -> dict[str, Any]:
        tiling = {name: getattr(self, name) for name in ("n_tilings", "n_tiles", "low", "high")}
        return {"tiling": tiling, "values_states": self.values_states}

    def _make_policy(self) -> BasePolicy:
        policy = cast(TilePolicy, super()._make_policy())
        policy.weights[:] = th.from_numpy(self._initial_sums() / policy.tiles.n_tilings)
        return policy

    @property
    def n_actions(self) -> int:
        """Number of actions."""
        return int(self.action_space.n)  # type: ignore[attr-defined]

    @abstractmethod
    def _initial_sums(self) -> Floats:
        """Each action's sum at the start, shape (A,)."""

    @abstractmethod
    def _probabilities(self, sums: Floats) -> Floats:
        """The probabilities of actions for sums of shape (n, A), same shape."""

    def compiled_agent(self, rng: np.random.Generator, seen: Any = None) -> LinearAgent:
        """The agent for compiled functions, with its weights in the memory of its policy."""
        tiles = self.policy.tiles
        here, ahead = np.empty((2, tiles.n_tilings), dtype=np.int64)
        room = Room(np.empty(len(tiles.dimensions)), here, ahead, np.empty(self.n_actions))
        return LinearAgent(
            self.settings()[0],
            self.policy.weights.numpy(),
            self._memory_in_use(),
            tiles,
            seen,
            room,
            handles_of([rng])[0],
        )

    def greedy_player(self, seen: Any) -> TilePlayer:
        """A player with the same actions as `predict` on compiled environments."""
        agent = self.compiled_agent(self.rng, seen)
        return TilePlayer(agent.weights, agent.tiles, agent.seen, agent.room)

    def _make_workspace(self, rng: np.random.Generator, n: int) -> TileWorkspace:
        return TileWorkspace(self.compiled_agent(rng), self.observation_space, rng, n)

    @in_given_spaces
    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The action of the highest sum, or an exploring one unless ``deterministic``.

        Takes one observation or an array of n, and returns an action or n of them, and ``state``;
        ``episode_start`` is not used.
        """
        if deterministic:
            return super().predict(observation, state, episode_start, deterministic)
        return self._exploring_actions(observation), state

    def action_probabilities(self, observations: NDArray[Any] | None = None) -> Floats:
        """The present probabilities of the policy that acts in training, shape (n, A).

        Args:
            observations: n of them; by default all numbers of a `Discrete` space.
        """
        if observations is None:
            check_space(self, "observations", self.observation_space)
            observations = np.arange(self.observation_space.n)  # type: ignore[attr-defined]
        return self._probabilities(self.policy.sums(observations))
