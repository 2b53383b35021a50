"""The warehouse in the dark: a robot that sees no further than the next cell."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.grid import GOAL, MOVES, Description
from envs.warehouse import WarehouseEnv
from mdp.transition_model import AnyInts

FREE, BLOCKED, GOAL_SEEN = 0, 1, 2

DEFAULT_MAP = (
    ".......",
    "#.#.#.#",
    "#.#.#.#",
    "#S#G#.#",
)


class DarkWarehouseEnv(WarehouseEnv):
    """A robot finds its way through a warehouse without light, from a place that it does not know.

    ## Description
    As Warehouse-v0, but the robot sees only the four cells beside its own, and may start anywhere.
    Aisles look alike, and so do the ways down and up in one. An agent with memory looks into one
    aisle after the other; without, it goes to and fro at random. The default map::

        .......
        #.#.#.#
        #.#.#.#
        #S#G#.#

    ## Action Space
    `Discrete(4)`: 0 up, 1 down, 2 left, 3 right.

    ## Observation Space
    `Discrete(81)`: a number of four digits in base 3, for the cells above, below, to the left and
    to the right: 0 an aisle, 1 a shelf or the outer wall, 2 the goal.

    ## Rewards
    -1 for a move, also for one against a shelf, +100 for the one onto the goal.

    ## Starting State
    Any cell but the goal from which the goal can be reached, all with equal probability; with
    `random_start=False` the cell marked `S`.

    ## Episode End
    The episode terminates on the goal. It is truncated after 100 steps when made by
    `gymnasium.make`.

    ## Information
    As Warehouse-v0: `position`, `bumped` and `is_success`, and `action_masks()`. States of the
    model are cells.

    ## Arguments
    - `desc`, `shelf_reward=-1`, `step_reward=-1`, `goal_reward=100`, `slip=0`: as Warehouse-v0
    - `random_start=True`: see Starting State
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`

    ## Version History
    - v0: the first version
    """

    def __init__(
        self,
        desc: Description = DEFAULT_MAP,
        shelf_reward: float = -1,
        step_reward: float = -1,
        goal_reward: float = 100,
        slip: float = 0,
        random_start: bool = True,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(
            desc,
            shelf_reward=shelf_reward,
            step_reward=step_reward,
            goal_reward=goal_reward,
            slip=slip,
            random_start=random_start,
            render_mode=render_mode,
        )
        letters = np.frombuffer(self.map.codes, np.uint8)
        kinds = np.where(letters == ord("#"), BLOCKED, FREE)
        kinds[letters == ord(GOAL)] = GOAL_SEEN
        kinds = np.pad(kinds.reshape(self.map.n_rows, -1), 1, constant_values=BLOCKED)
        height, width = self.map.n_rows, self.map.n_columns
        beside = [kinds[1 + y : 1 + y + height, 1 + x : 1 + x + width] for y, x in MOVES]
        self._views: NDArray[np.int64] = np.ravel_multi_index(tuple(beside), (3,) * 4).ravel()
        self.observation_space = spaces.Discrete(3 ** len(MOVES))

    def observation_of(self, states: AnyInts) -> NDArray[Any]:
        """What is beside each of many cells, shape (n,)."""
        return self._views[states]

    def _observe(self) -> int:
        return int(self._views[self.s])
