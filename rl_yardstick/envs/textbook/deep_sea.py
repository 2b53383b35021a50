"""A sea whose treasure only agents find that explore deeply."""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar

import numpy as np

from rl_yardstick.envs.argument_checks import check_flag, check_number, check_whole_number
from rl_yardstick.envs.grid import MapEnv
from rl_yardstick.mdp.transition_model import TransitionModel

MOST_SIZE = 1000


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
    drawn, then a standard normal one. The model has the means of random rewards, and their variance.

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
        return _model(self.size, self.deterministic, self.move_cost, self.map_seed)

    def cell_of(self, state: int) -> int:
        """Where a state lies; the ground is shown in the lower right corner."""
        return min(state, self.size**2 - 1)


@lru_cache(maxsize=4)
def _model(size: int, still: bool, move_cost: float, map_seed: int | None) -> TransitionModel:
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
