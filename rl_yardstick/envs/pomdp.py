"""Partially observable environments, whose states hold the last noisy observation (reading).

The observation of a finite environment is a function of its state (`observation_of`). Where
readings are random, the state holds the last one beside the hidden state. So steps, exact figures
and compiled training need no code for noise.
"""

from __future__ import annotations

from functools import lru_cache, reduce
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.envs.argument_checks import check_number
from rl_yardstick.envs.finite_env import summing_to_one
from rl_yardstick.envs.grid import MapEnv
from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel


class World(NamedTuple):
    """A decision process with readings."""

    model: TransitionModel  # its states are pairs of hidden state and last reading
    hidden: Ints  # the hidden state in each state, shape (S,)
    reading: Ints  # the last reading in each state, shape (S,)


def with_readings(hidden: TransitionModel, first: Floats, later: Floats) -> World:
    """Add readings to a decision process whose states are hidden.

    Args:
        hidden: the decision process; H states, A actions.
        first: the probability of each reading in a starting state, shape (H, O).
        later: the probability of each reading after an action that led to a state, shape (A, H, O).
            Where the episode ends, only the first reading that is possible is kept.
    """
    n_hidden, n_actions, n_outcomes = hidden.prob.shape
    n_readings = first.shape[-1]
    is_there = (first > 0) | (later > 0).any(axis=0)
    state_hidden, state_reading = np.nonzero(is_there)
    number = np.zeros(is_there.shape, np.int64)
    number[is_there] = np.arange(len(state_hidden))

    action = np.arange(n_actions)[None, :, None]
    chances = later[action, hidden.next_state]  # (H, A, K, O)
    last = np.eye(n_readings)[(chances > 0).argmax(axis=3)]
    chances = np.where(hidden.terminated[..., None], last, chances)
    joint = hidden.prob[..., None] * chances
    shape = (n_hidden, n_actions, n_outcomes * n_readings)
    following = number[hidden.next_state[..., None], np.arange(n_readings)]
    # Possible outcomes first, in their order, and no more columns than needed.
    possible = joint.reshape(shape) > 0
    order = np.argsort(~possible, axis=2, kind="stable")[:, :, : int(possible.sum(axis=2).max())]

    def of_states(array: NDArray[Any]) -> NDArray[Any]:
        full = np.broadcast_to(array, joint.shape).reshape(shape)
        return np.take_along_axis(full, order, axis=2)[state_hidden]

    model = TransitionModel(
        prob=summing_to_one(of_states(joint)),
        next_state=of_states(following),
        reward=of_states(hidden.reward[..., None]),
        terminated=of_states(hidden.terminated[..., None]),
        initial=summing_to_one(hidden.initial[state_hidden] * first[state_hidden, state_reading]),
    )
    return World(model, state_hidden, state_reading)


LISTEN, OPEN_LEFT, OPEN_RIGHT = 0, 1, 2
SILENCE, HEARD_LEFT, HEARD_RIGHT = 0, 1, 2


class TigerEnv(MapEnv):
    """Behind one of two doors waits a tiger; who listens longer knows better which.

    ## Description
    Cassandra, Kaelbling and Littman (Acting Optimally in Partially Observable Stochastic Domains,
    1994): a tiger is behind the left or the right door, and a reward behind the other. The agent
    may open a door, or listen, which costs a little and tells the right side with probability .85.
    After a door has been opened, the tiger and the reward are put behind the doors anew, and the
    game goes on.

    An agent without memory knows only what it heard last, which is not enough to open a door, so
    that it can only listen. An agent with memory counts: it opens a door when it has heard the
    tiger twice more often behind the other one.

    ## Action Space
    `Discrete(3)`: 0 listen, 1 open the left door, 2 open the right door.

    ## Observation Space
    `Discrete(3)`: 0 nothing, at the start and after a door was opened; 1 the tiger was heard on the
    left, 2 on the right. In the original, noise without meaning is heard after a door was opened.

    ## Rewards
    - listening: -1
    - opening the door without the tiger: +10
    - opening the door with the tiger: -100

    ## Starting State
    The tiger is behind either door with equal probability.

    ## Episode End
    The episode never terminates. It is truncated after 10 steps when made by `gymnasium.make`.

    ## Information
    States of the model are pairs of the tiger's door and what was heard last.

    ## Arguments
    - `accuracy=0.85`: probability to hear the tiger where it is
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    rows = ("MM",)  # the two doors; the robot stands where the tiger is
    action_names: ClassVar[tuple[str, ...]] = ("listen", "open left", "open right")

    def __init__(self, accuracy: float = 0.85, render_mode: str | None = None) -> None:
        self.accuracy = check_number("accuracy", accuracy, 0, 1)
        world = _tiger(self.accuracy)
        super().__init__(world.model.n_states, 3, render_mode)
        self.observation_space = spaces.Discrete(3)

    def transition_model(self) -> TransitionModel:
        return _tiger(self.accuracy).model

    def observation_of(self, states: Any) -> NDArray[Any]:
        """What was heard last."""
        heard: NDArray[Any] = _tiger(self.accuracy).reading[states]
        return heard

    def cell_of(self, state: int) -> int:
        return int(_tiger(self.accuracy).hidden[state])


@lru_cache(maxsize=4)
def _tiger(accuracy: float) -> World:
    shape = (2, 3, 2)
    prob, reward = np.full(shape, 0.5), np.full(shape, 10.0)
    prob[:, LISTEN] = np.eye(2)
    reward[:, LISTEN] = -1
    reward[0, OPEN_LEFT] = reward[1, OPEN_RIGHT] = -100
    next_state = np.broadcast_to(np.arange(2), shape)
    first = np.tile([1.0, 0.0, 0.0], (2, 1))
    later = np.stack([first] * 3)
    later[LISTEN] = [[0, accuracy, 1 - accuracy], [0, 1 - accuracy, accuracy]]
    hidden = TransitionModel(prob, next_state, reward, np.zeros(shape, np.bool_), np.full(2, 0.5))
    return with_readings(hidden, first, later)


ROWS = ("...........", "##.#.#.#G##")
# Row and column of each cell, row by row; the goal is the last one.
CELLS = [(y, x) for y, row in enumerate(ROWS) for x, letter in enumerate(row) if letter != "#"]
# North, east, south, west; numbers of facings.
STEPS = ((-1, 0), (0, 1), (1, 0), (0, -1))
SOUTH = 2
STAY, FORWARD = 0, 1
# Probabilities of turning right by 0, 90, 180 and 270 degrees, for turns right, around and left.
TURNS = ((0.1, 0.7, 0.1, 0.1), (0.1, 0.15, 0.6, 0.15), (0.1, 0.1, 0.1, 0.7))
# Outcomes of a move forward: the direction, the new facing, both by turns, and the probability.
# Otherwise the robot stays as it is, and also where a wall is in the way.
MOVES = ((0, 0, 0.8), (1, 1, 0.05), (3, 3, 0.05), (2, 0, 0.025), (2, 2, 0.025))
SEES_WALL, SEES_NO_WALL = 0.9, 0.95  # where there is one, and where there is none
N_WALL_READINGS, N_READINGS = 16, 21


class HallwayEnv(MapEnv):
    """A robot in a hallway feels walls beside it, often wrongly, and is to find an alcove.

    ## Description
    The hallway of Littman, Cassandra and Kaelbling (Learning Policies for Partially Observable
    Environments: Scaling Up, 1995): eleven cells in a row, four alcoves to the south of them, and
    the goal ``G`` in one of these::

        ...........
        ##.#.#.#G##

    The robot faces north, east, south or west. It does not know where it is, and feels only whether
    there are walls in front of it, to its right, behind it and to its left.

    The probabilities are those of the authors' file `hallway.POMDP`, which rounds them to six
    digits. Two things differ: the episode ends at the goal, where the original begins anew, and the
    first reading comes before the first action.

    ## Action Space
    `Discrete(5)`: 0 stay, 1 forward, 2 turn right, 3 turn around, 4 turn left. Forward leads
    forward with probability .8, to each side with .05 (the robot then faces that way), and back
    with .05 (half of it facing the other way); else, and where there is a wall, the robot stays as
    it is. Turning right or left succeeds with probability .7, around with .6.

    ## Observation Space
    `Discrete(21)`: 0 to 15 the sum of 8 for a wall in front, 4 to the right, 2 behind and 1 to the
    left. A wall is felt with probability .9, and where there is none, one is felt with .05. Facing
    south above an alcove, the robot sees its sign instead, without error: 16 to 19, where 19 is the
    goal's alcove. At the goal it sees 20.

    ## Rewards
    1 at the goal.

    ## Starting State
    Any cell but the goal and any facing, with equal probability.

    ## Episode End
    The episode terminates at the goal. It is truncated after 30 steps when made by
    `gymnasium.make`.

    ## Information
    States of the model are triples of cell, facing and last reading.

    ## Arguments
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    rows = ROWS
    action_names: ClassVar[tuple[str, ...]] = (
        "stay", "forward", "turn right", "turn around", "turn left",
    )  # fmt: skip

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(_hallway().model.n_states, len(self.action_names), render_mode)
        self.observation_space = spaces.Discrete(N_READINGS)

    def transition_model(self) -> TransitionModel:
        return _hallway().model

    def observation_of(self, states: Any) -> NDArray[Any]:
        """The last reading."""
        readings: NDArray[Any] = _hallway().reading[states]
        return readings

    def cell_of(self, state: int) -> int:
        row, column = CELLS[int(_hallway().hidden[state]) // len(STEPS)]
        return row * len(ROWS[0]) + column


@lru_cache(maxsize=1)
def _hallway() -> World:
    n_states = len(CELLS) * len(STEPS)
    prob = np.zeros((n_states, 2 + len(TURNS), len(MOVES) + 1))
    next_state = np.zeros(prob.shape, np.int64)
    readings = np.zeros((n_states, N_READINGS))
    signs = [cell for cell in CELLS if (cell[0] + 1, cell[1]) in CELLS]
    for state in range(n_states):
        (row, column), facing = CELLS[state // len(STEPS)], state % len(STEPS)
        beside = [
            (row + STEPS[(facing + turn) % 4][0], column + STEPS[(facing + turn) % 4][1])
            for turn in range(4)
        ]
        next_state[state] = state
        prob[state, STAY, 0] = 1
        for turns, action in zip(TURNS, range(2, 5), strict=True):
            prob[state, action, :4] = turns
            next_state[state, action, :4] = state - facing + (facing + np.arange(4)) % 4
        for k, (way, turn, chance) in enumerate(MOVES):
            prob[state, FORWARD, k] = chance
            if beside[way] in CELLS:
                place = CELLS.index(beside[way])
                next_state[state, FORWARD, k] = 4 * place + (facing + turn) % 4
        prob[state, FORWARD, -1] = 1 - sum(chance for _, _, chance in MOVES)
        if CELLS[-1] == (row, column):
            readings[state, -1] = 1
        elif facing == SOUTH and (row, column) in signs:
            readings[state, N_WALL_READINGS + signs.index((row, column))] = 1
        else:
            felt = np.array([1 - SEES_NO_WALL if b in CELLS else SEES_WALL for b in beside])
            chances = np.stack([1 - felt, felt], axis=1)
            readings[state, :N_WALL_READINGS] = reduce(np.kron, chances)
    at_goal = next_state // len(STEPS) == len(CELLS) - 1
    is_over = np.arange(n_states) // len(STEPS) == len(CELLS) - 1
    reward = np.where(is_over[:, None, None], 0.0, at_goal.astype(np.float64))
    initial = np.where(is_over, 0.0, 1 / (~is_over).sum())
    hidden = TransitionModel(prob, next_state, reward, at_goal, initial)
    return with_readings(hidden, readings, np.stack([readings] * prob.shape[1]))
