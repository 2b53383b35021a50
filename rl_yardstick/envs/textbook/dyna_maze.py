"""Mazes in which planning is compared, two of which change."""

from __future__ import annotations

from typing import Any

from rl_yardstick.envs.argument_checks import (
    check_choice,
    check_flag,
    check_number,
    check_whole_number,
)
from rl_yardstick.envs.grid import GridDynamics, GridMap, GridWorld, Tile

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
# Each maze before its change, and after.
MAZES = {"dyna": (DYNA, DYNA), "blocking": BLOCKING, "shortcut": SHORTCUT}
MOST_STEPS = 10**12


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
        self.change_after_steps = change_after_steps
        self.steps_done = 0
        self._becomes = None if change_after_steps is None else last
        super().__init__(
            last if changed and change_after_steps is None else first,
            self._tiles,
            edge=Tile(step.reward, blocked=True),
            slip=slip,
            random_start=random_start,
            render_mode=render_mode,
        )

    @property
    def is_stationary(self) -> bool:
        """Whether the maze stays as it is."""
        return self.change_after_steps is None

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
        passable = [letter for letter, tile in self._tiles.items() if not tile.blocked]
        self.map = GridMap.read(rows, self._tiles, passable)
        edge, slip = self.dynamics.edge, 1 - self.dynamics.outcome_prob[0]
        self.dynamics = GridDynamics(self.map, self._tiles, edge, slip)
        for worked_out in ("P", "initial_state_distrib", "_starts"):
            self.__dict__.pop(worked_out, None)
        # The next picture is of another map.
        self.close()
        self._steps = set()
