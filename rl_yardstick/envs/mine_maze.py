"""A maze with mines to avoid and power to collect on the way."""

from __future__ import annotations

from rl_yardstick.envs.argument_checks import check_number
from rl_yardstick.envs.grid import Description, GridWorld, Tile

DEFAULT_MAP = (
    "S..M..",
    ".M.P.M",
    ".M.M..",
    "...M.P",
    ".M...M",
    ".PM..G",
)


class MineMazeEnv(GridWorld):
    """A robot crosses a minefield, and may collect power on its way.

    ## Description
    The robot walks from the start `S` to the goal `G` between mines `M`; on some cells lies power
    `P`, which it collects by stepping on it. The default map::

        S..M..
        .M.P.M
        .M.M..
        ...M.P
        .M...M
        .PM..G

    The shortest way takes 10 moves; the best way has that length and passes one cell with power.

    ## Action Space
    `Discrete(4)`: 0 up, 1 down, 2 left, 3 right.

    ## Observation Space
    `Discrete(cells * 2**powers)`. What has been collected belongs to the state, or the rewards to
    come would depend on the past: the observation is the position, row times the number of columns
    plus column, plus the number of cells times a bit mask. Bit i of the mask is set when the i-th
    power, counted row by row, has been collected.

    ## Rewards
    Every move costs 1, also one against the outer wall, where the robot stays. The cell that the
    robot enters adds:

    - a mine: -100
    - power, the first time in an episode: +1
    - the goal: +100

    The best return on the default map is -10 + 1 + 100 = 91.

    ## Starting State
    The cell marked `S`, with nothing collected; with `random_start=True` any cell that is neither
    goal, mine nor power and from which the goal can be reached, all with equal probability.

    ## Episode End
    The episode terminates on the goal or a mine. It is truncated after 100 steps when made by
    `gymnasium.make`.

    ## Information
    `reset` and `step` give `position` (row, column), `bumped` (whether the robot ran into the outer
    wall) and `is_success` (whether it stands on the goal).
    `action_masks()` tells which moves do not run into the outer wall; with `slip` it
    considers the intended move, and in a cell that is walled in it allows all.

    ## Arguments
    - `desc`: the map, as a list of rows or the path to a text file with one row per line
    - `step_reward=-1`, `mine_reward=-100`, `power_reward=1`, `goal_reward=100`: the rewards
    - `slip=0`: probability that the robot moves sideways instead, half of it to each side
    - `random_start=False`: see Starting State
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    def __init__(
        self,
        desc: Description = DEFAULT_MAP,
        step_reward: float = -1,
        mine_reward: float = -100,
        power_reward: float = 1,
        goal_reward: float = 100,
        slip: float = 0,
        random_start: bool = False,
        render_mode: str | None = None,
    ) -> None:
        step = check_number("step_reward", step_reward)
        mine = check_number("mine_reward", mine_reward)
        goal = check_number("goal_reward", goal_reward)
        tiles = {
            "S": Tile(step),
            ".": Tile(step),
            "M": Tile(step + mine, terminated=True),
            "P": Tile(step, bonus=check_number("power_reward", power_reward)),
            "G": Tile(step + goal, terminated=True),
        }
        edge = Tile(step, blocked=True)
        super().__init__(
            desc, tiles, edge, slip=slip, random_start=random_start, render_mode=render_mode
        )
