"""Fields, mazes and a sea on a grid, from textbooks and papers."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from rl_yardstick.envs.argument_checks import (
    check_choice,
    check_flag,
    check_number,
    check_whole_number,
)
from rl_yardstick.envs.grid import MOVES, GridWorld, MapEnv, Tile
from rl_yardstick.mdp.transition_model import TransitionModel

# The windy field.
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
# The mazes, before their change and after; the size of the sea.
DYNA = (
    ".......#G",
    "..#....#.",
    "S.#....#.",
    "..#......",
    ".....#...",
    ".........",
)
OPEN_ROWS = ("........G", ".........", ".........")
LOWER_ROWS = (".........", "...S.....")
BLOCKING = (*OPEN_ROWS, "########.", *LOWER_ROWS), (*OPEN_ROWS, ".########", *LOWER_ROWS)
SHORTCUT = (*OPEN_ROWS, ".########", *LOWER_ROWS), (*OPEN_ROWS, ".#######.", *LOWER_ROWS)
MAZES = {"dyna": (DYNA, DYNA), "blocking": BLOCKING, "shortcut": SHORTCUT}
MOST_STEPS, MOST_SIZE = 10**12, 1000


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
        # The intended move of each action: rows down, columns to the right.
        self.steps: tuple[tuple[int, int], ...] = STEPS[self.moves]
        super().__init__(N_ROWS * N_COLUMNS, len(self.steps), render_mode)

    def transition_model(self) -> TransitionModel:
        return _windy(self.moves, self.stochastic, self.step_reward)


@lru_cache(maxsize=8)
def _windy(moves: str, stochastic: bool, step_reward: float) -> TransitionModel:
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


class DynaMazeEnv(GridWorld):
    """A maze with a reward at its goal alone, where an agent that plans soon knows its way.

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), example 8.1, with walls `#`, the start
    `S` and the goal `G`; the shortest way takes 14 moves::

        .......#G
        ..#....#.
        S.#....#.
        ..#......
        .....#...
        .........

    Two others change. In the blocking maze (example 8.2) the way on the right, of 10 moves, closes,
    and one on the left opens, of 16. In the shortcut maze (example 8.3) there is the way on the
    left, and one on the right opens besides::

        blocking  ........G    ........G    shortcut  ........G    ........G
                  .........    .........              .........    .........
                  .........    .........              .........    .........
                  ########. -> .########              .######## -> .#######.
                  .........    .........              .........    .........
                  ...S.....    ...S.....              ...S.....    ...S.....

    `maze` chooses the maze, and `changed` whether it is the changed one or the first one. A maze
    that does not change has an exact model and an optimum. With `change_after_steps` the
    environment changes once: after that many steps since it was made, over all its episodes, the
    first maze turns into the changed one (later, if the robot stands where a wall comes: when it
    has moved on). Its dynamics then depend on time, so there is no model and no optimum. That is
    meant for training: with `env_kwargs: {maze: blocking, changed: true}` and `train_env_kwargs:
    {change_after_steps: 1000}` an agent trains in a maze that changes, as in the book, and is
    evaluated exactly in the changed one. If several environments train together, each counts its
    own steps.

    ## Action Space
    `Discrete(4)`: 0 up, 1 down, 2 left, 3 right.

    ## Observation Space
    `Discrete(54)`: row times 9 plus column, row 0 being at the top.

    ## Rewards
    1 for the move onto the goal, 0 for all others. Moves against a wall, or the edge, change
    nothing. The sum of rewards says whether the goal was reached, and the length of the episode how
    fast; the book discounts by .95.

    ## Starting State
    The cell marked `S`; with `random_start=True` any cell but the goal from which the goal can be
    reached, all with equal probability.

    ## Episode End
    The episode terminates on the goal. It is truncated after 100 steps when made by
    `gymnasium.make`; the book has no limit.

    ## Information
    `reset` and `step` give `position` (row, column), `bumped` (whether the robot ran into a wall
    or the edge) and `is_success` (whether it stands on the goal).
    `action_masks()` tells which moves do not run into a wall or the edge; with `slip` it considers
    the intended move.

    ## Arguments
    - `maze="dyna"`: or `"blocking"` or `"shortcut"`
    - `changed=False`: whether it is the changed maze; `"dyna"` never changes
    - `change_after_steps=None`: see Description; needs `changed=True`
    - `step_reward=0`, `goal_reward=1`: the rewards
    - `slip=0`: probability that the robot moves sideways instead, half of it to each side
    - `random_start=False`: see Starting State
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    def __init__(
        self,
        maze: str = "dyna",
        changed: bool = False,
        change_after_steps: int | None = None,
        step_reward: float = 0,
        goal_reward: float = 1,
        slip: float = 0,
        random_start: bool = False,
        render_mode: str | None = None,
    ) -> None:
        first, last = MAZES[check_choice("maze", maze, tuple(MAZES))]
        if check_flag("changed", changed) and first == last:
            raise ValueError(f"changed: the maze {maze!r} never changes")
        if change_after_steps is not None:
            check_whole_number("change_after_steps", change_after_steps, 1, MOST_STEPS)
            if not changed:
                raise ValueError("change_after_steps needs changed: true, what the maze becomes")
        step = Tile(check_number("step_reward", step_reward))
        self._tiles = {
            "#": Tile(step.reward, blocked=True),
            ".": step,
            "S": step,
            "G": Tile(step.reward + check_number("goal_reward", goal_reward), terminated=True),
        }
        self.change_after_steps, self.steps_done = change_after_steps, 0
        self.is_stationary = change_after_steps is None
        self._becomes = None if self.is_stationary else last
        desc, edge = last if changed and self.is_stationary else first, self._tiles["#"]
        super().__init__(
            desc, self._tiles, edge, slip=slip, random_start=random_start, render_mode=render_mode
        )

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        result = super().step(action)
        if self._becomes is not None and self.change_after_steps is not None:
            self.steps_done += 1
            letter = "".join(self._becomes)[self.s]
            if self.steps_done >= self.change_after_steps and letter != "#":
                self._change(self._becomes)
        return result

    def _change(self, rows: tuple[str, ...]) -> None:
        """Replace the maze by another one, between two steps."""
        self._becomes = None
        edge, slip = self.dynamics.edge, 1 - self.dynamics.outcome_prob[0]
        self._set_map(rows, self._tiles, edge, slip)
        for worked_out in ("P", "initial_state_distrib", "_starts"):
            self.__dict__.pop(worked_out, None)
        # The next picture is of another map.
        self.close()
        self._steps = set()


class DeepSeaEnv(MapEnv):
    """A diver sinks a row each step; only right, right, right leads to the treasure.

    ## Description
    Osband and others ("Behaviour suite for reinforcement learning", 2020), and Osband, Van Roy,
    Russo and Wen ("Deep exploration via randomized value functions", 2019): a square of `size` rows
    and columns. The diver starts in the upper left corner. Each step leads one row down, and one
    column to the left or to the right. The treasure lies in the lower right corner, and moving
    right costs a little. Random actions find it once in 2**size episodes.

    In each cell `map_seed` decides which of the two actions goes right, so no single action leads
    to the treasure.

    The best return is 1 - 0.01 = 0.99. With `deterministic=False` and q = 1 - 1/size it is
    q**(size - 1) - 0.01 * (1 - q**size): if a failed move has taken the agent off the way, it saves
    the cost of the rest.

    ## Action Space
    `Discrete(2)`: one is left, the other right, depending on the cell.

    ## Observation Space
    `Discrete(size * size + 1)`: row times `size` plus column, row 0 being at the top; the last
    number is the ground below the lowest row.

    ## Rewards
    - each attempted move to the right: -0.01 / size
    - the move to the right in the lower right corner: +1
    - with `deterministic=False`, any move in either lower corner: a standard normal number

    ## Starting State
    The upper left corner.

    ## Episode End
    The episode terminates after `size` steps. The limit that `gymnasium.make` sets, 1000, is never
    below that.

    ## Information
    `reset` and `step` give nothing more. Each draws one uniform number; a step whose reward is
    drawn, then a standard normal one. The model has the means and variances of such rewards.

    ## Arguments
    - `size=10`: number of rows and of columns
    - `deterministic=True`: whether all moves succeed. If not, a move to the right fails with
      probability 1 / size and sinks straight down, and two rewards are drawn, see Rewards
    - `move_cost=0.01`: the cost of `size` moves to the right together
    - `map_seed=0`: the same seed gives the same meaning of actions; None makes 1 always right
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    action_names: ClassVar[tuple[str, ...]] = ("action 0", "action 1")

    def __init__(
        self,
        size: int = 10,
        deterministic: bool = True,
        move_cost: float = 0.01,
        map_seed: int | None = 0,
        render_mode: str | None = None,
    ) -> None:
        self.size = check_whole_number("size", size, 2, MOST_SIZE)
        self.deterministic = check_flag("deterministic", deterministic)
        self.move_cost = check_number("move_cost", move_cost)
        seed = None if map_seed is None else check_whole_number("map_seed", map_seed, 0, 2**63 - 1)
        self.map_seed = seed
        top = f"S{'.' * (self.size - 1)}"
        self.rows = (top, *["." * self.size] * (self.size - 2), "." * (self.size - 1) + "G")
        super().__init__(self.size**2 + 1, 2, render_mode)

    def transition_model(self) -> TransitionModel:
        return _sea(self.size, self.deterministic, self.move_cost, self.map_seed)

    def cell_of(self, state: int) -> int:
        """Where a state lies; the ground is shown in the lower right corner."""
        return min(state, self.size**2 - 1)


@lru_cache(maxsize=4)
def _sea(size: int, still: bool, move_cost: float, map_seed: int | None) -> TransitionModel:
    ground = size**2
    row, column = np.divmod(np.arange(ground), size)
    right = np.ones(ground, np.int64)
    if map_seed is not None:
        right = np.random.default_rng(map_seed).integers(2, size=ground)
    is_right = np.append(right, 0)[:, None] == np.arange(2)
    is_right[ground] = False

    slip = 0.0 if still else 1 / size
    prob = np.stack([1 - slip * is_right, slip * is_right], axis=2)
    beside = np.clip(column[:, None] + np.where(is_right[:ground], 1, -1), 0, size - 1)
    below = (row[:, None, None] + 1) * size + np.stack([beside, beside], axis=2)
    # The second outcome, of a move to the right that fails, stays in its column.
    below[..., 1] = ((row + 1) * size + column)[:, None]
    next_state = np.full((ground + 1, 2, 2), ground)
    next_state[:ground] = np.minimum(below, ground)

    reward = np.where(is_right, -move_cost / size, 0.0)
    reward[ground - 1] += is_right[ground - 1]
    noisy = np.zeros(ground + 1)
    noisy[[ground - size, ground - 1]] = not still
    k = 1 if still else 2
    return TransitionModel(
        prob=prob[..., :k],
        next_state=next_state[..., :k],
        reward=np.repeat(reward[..., None], k, axis=2),
        terminated=next_state[..., :k] == ground,
        initial=np.eye(1, ground + 1)[0],
        reward_variance=None if still else np.broadcast_to(noisy[:, None, None], prob.shape),
    )
