"""Agents whose values or preferences are sums of weights: one for each active tile and action.

Compiled functions, shared by the interpreted and the compiled training loop. What an algorithm adds
is how it chooses among the sums, and how it learns. Step sizes are divided by the number of
tilings, so that a step size of 1 moves a sum all the way to its target.

Source: Sutton and Barto (2nd edition), sections 9.4 and 9.5.4.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from agents.compiled.dispatch import CompiledOnlyError, by_type
from agents.compiled.loop import act, learn_from_step
from agents.compiled.training_records import UNDECIDED
from agents.linear.tile_coding import Tiles, active_tiles
from agents.networks.observations import BEFORE, observe
from machine_code.compiling import called, kernel
from mdp.array_types import Floats, Ints


class Room(NamedTuple):
    """Where numbers are worked out; what it holds between two calls means nothing.

    Attributes:
        vector: an observation, shape (d,).
        tiles: the active tiles of an observation, shape (n_tilings,).
        next_tiles: those of the next one, likewise.
        sums: a number for each action, shape (A,).
    """

    vector: Floats
    tiles: Ints
    next_tiles: Ints
    sums: Floats


class LinearAgent(NamedTuple):
    """An agent as compiled functions see it.

    Attributes:
        settings: a record of the type that its class has.
        weights: of action values or preferences, in the memory of its policy, shape (tiles, A).
        memory: what else it keeps; each algorithm has a type of its own for that.
        tiles: how observations become tiles.
        seen: how observations are read from the environments' records.
        room: for its work.
        rng: a handle of its generator.
    """

    settings: Any
    weights: Floats
    memory: Any
    tiles: Tiles
    seen: Any
    room: Room
    rng: Any


class HandedVectors(NamedTuple):
    """Observations that the interpreted loop hands over, of environments that know their number.

    Attributes:
        before: the observations before the step, shape (n, d).
        after: those after it, before any reset, shape (n, d).
    """

    before: Floats
    after: Floats

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
