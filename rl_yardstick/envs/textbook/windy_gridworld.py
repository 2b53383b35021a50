"""A grid with a wind across it that blows the walker upwards."""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar

import numpy as np

from rl_yardstick.envs.argument_checks import check_choice, check_flag, check_number
from rl_yardstick.envs.grid import MOVES, MapEnv
from rl_yardstick.mdp.transition_model import TransitionModel

MAP = (
    "..........",
    "..........",
    "..........",
    "S......G..",
    "..........",
    "..........",
    "..........",
)
WIND = (0, 0, 0, 1, 1, 1, 2, 2, 1, 0)
N_ROWS, N_COLUMNS = len(MAP), len(MAP[0])
START, GOAL = 30, 37
DIAGONALS = ((-1, -1), (-1, 1), (1, -1), (1, 1))
STEPS = {"rook": MOVES, "king": MOVES + DIAGONALS, "king_and_stay": (*MOVES, *DIAGONALS, (0, 0))}


class WindyGridworldEnv(MapEnv):
    """A walker crosses a field with a wind that shifts each step upwards, by column.

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), example 6.5: a grid of 7 rows and 10
    columns, without walls. From the start `S` the walker is to reach the goal `G`; in the columns
    between blows a wind::

        ..........
        ..........
        ..........
        S......G..
        ..........
        ..........
        ..........
        0001112210   rows that a step which leaves the column is blown upwards

    A step is the move plus the wind of the column that it leaves, but never beyond the grid. The
    shortest way takes 15 steps. With king's moves (exercise 6.9) it takes 7, and staying put, a
    ninth move, gains nothing. With `stochastic=True` (exercise 6.10) a wind is stronger by one a
    third of the time, and weaker by one a third of the time.

    ## Action Space
    With `moves="rook"`, `Discrete(4)`: 0 up, 1 down, 2 left, 3 right. With `"king"`, `Discrete(8)`:
    these and 4 up and left, 5 up and right, 6 down and left, 7 down and right. With
    `"king_and_stay"`, `Discrete(9)`: these and 8 to stay put, which the wind moves all the same.

    ## Observation Space
    `Discrete(70)`: row times 10 plus column, row 0 being at the top.

    ## Rewards
    -1 a step.

    ## Starting State
    The cell marked `S`.

    ## Episode End
    The episode terminates on the goal. It is truncated after 1000 steps when made by
    `gymnasium.make`; the book has no limit.

    ## Arguments
    - `moves="rook"`: see Action Space
    - `stochastic=False`: whether the wind varies
    - `step_reward=-1`: the reward of each step
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    rows = MAP
    action_names: ClassVar[tuple[str, ...]] = (
        *("up", "down", "left", "right"),
        *("up left", "up right", "down left", "down right", "stay"),
    )

    def __init__(
        self,
        moves: str = "rook",
        stochastic: bool = False,
        step_reward: float = -1,
        render_mode: str | None = None,
    ) -> None:
        self.moves = check_choice("moves", moves, tuple(STEPS))
        self.stochastic = check_flag("stochastic", stochastic)
        self.step_reward = check_number("step_reward", step_reward)
        super().__init__(N_ROWS * N_COLUMNS, len(self.steps), render_mode)

    @property
    def steps(self) -> tuple[tuple[int, int], ...]:
        """The intended move of each action: rows down, columns to the right."""
        return STEPS[self.moves]

    def transition_model(self) -> TransitionModel:
        return _model(self.moves, self.stochastic, self.step_reward)


@lru_cache(maxsize=8)
def _model(moves: str, stochastic: bool, step_reward: float) -> TransitionModel:
    row, column = np.divmod(np.arange(N_ROWS * N_COLUMNS)[:, None, None], N_COLUMNS)
    down, right = np.array(STEPS[moves]).T[:, :, None]
    gusts = np.array([0, 1, -1] if stochastic else [0])
    wind = np.array(WIND)[column]
    blown = wind + gusts * (wind > 0)
    to_row = np.clip(row + down - blown, 0, N_ROWS - 1)
    to_column = np.clip(column + right, 0, N_COLUMNS - 1)
    next_state = to_row * N_COLUMNS + to_column
    next_state[GOAL] = GOAL
    prob = np.array([1 / 3, 1 / 3, 1 - 2 / 3] if stochastic else [1.0])
    reward = np.full(next_state.shape, step_reward)
    reward[GOAL] = 0.0
    return TransitionModel(
        prob=np.broadcast_to(prob, next_state.shape),
        next_state=next_state,
        reward=reward,
        terminated=next_state == GOAL,
        initial=np.eye(N_ROWS * N_COLUMNS)[START],
    )
