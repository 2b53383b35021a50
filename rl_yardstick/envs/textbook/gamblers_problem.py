"""A gambler who stakes on a coin until the capital is large enough, or gone."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rl_yardstick.envs.argument_checks import check_number, check_whole_number
from rl_yardstick.envs.bars import Bar, Bars, BarsEnv
from rl_yardstick.envs.finite_env import MaskedFiniteEnv, summing_to_one
from rl_yardstick.mdp.transition_model import Bools, TransitionModel

LARGEST_GOAL = 2000


class GamblersProblemEnv(BarsEnv, MaskedFiniteEnv):
    """Stakes on a coin that comes up heads with a known probability: all at once, or a little?

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), example 4.3: a gambler wins the stake if
    the coin comes up heads, else loses it, and goes on until the capital is 100, or gone. The value
    of a capital is the probability to reach 100. With heads in 40 of 100 throws it is .4 for a
    capital of 50 and .16 for 25; staking as much as allowed is then optimal, as are many other
    policies.

    ## Action Space
    `Discrete(goal // 2 + 1)`: the stake, at most the capital, and at most what is missing to the
    goal, as `action_masks()` says. A larger stake counts as 0, which is allowed and changes
    nothing.

    ## Observation Space
    `Discrete(goal + 1)`: the capital.

    ## Rewards
    1 for reaching the goal, else 0.

    ## Starting State
    A capital of 1 to `goal - 1`, all with equal probability; with `start_capital` that one.

    ## Episode End
    The episode terminates when the capital is 0 or the goal. It is truncated after 1000 steps when
    made by `gymnasium.make`.

    ## Information
    `reset` and `step` give nothing more. One uniform number is drawn by each: it is heads if it
    lies below `heads_probability`.

    ## Arguments
    - `heads_probability=0.4`: of the coin
    - `goal=100`: the capital to reach, 2 or more
    - `start_capital=None`: see Starting State
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    def __init__(
        self,
        heads_probability: float = 0.4,
        goal: int = 100,
        start_capital: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.heads_probability = check_number("heads_probability", heads_probability, 0, 1)
        self.goal = check_whole_number("goal", goal, 2, LARGEST_GOAL)
        if start_capital is not None:
            start_capital = check_whole_number("start_capital", start_capital, 1, self.goal - 1)
        self.start_capital = start_capital
        super().__init__(self.goal + 1, self.goal // 2 + 1, render_mode)

    def transition_model(self) -> TransitionModel:
        return _model(self.heads_probability, self.goal, self.start_capital)

    def masks_of_states(self) -> Bools:
        return allowed_stakes(self.goal)

    def _bars(self) -> Bars:
        title = "start" if self.last_action is None else f"stake {self.last_action}"
        return Bars(title, [Bar("capital", self.s, f"{self.s} of {self.goal}")], 0, self.goal)


def allowed_stakes(goal: int) -> Bools:
    """The allowed stakes at each capital, bool of shape (goal + 1, goal // 2 + 1)."""
    capital = np.arange(goal + 1)[:, None]
    allowed: Bools = np.arange(goal // 2 + 1) <= np.minimum(capital, goal - capital)
    return allowed


@lru_cache(maxsize=4)
def _model(heads: float, goal: int, start: int | None) -> TransitionModel:
    capital = np.arange(goal + 1)[:, None]
    stake = np.where(allowed_stakes(goal), np.arange(goal // 2 + 1), 0)
    next_state = np.stack([capital + stake, capital - stake], axis=2)
    over = (capital == 0) | (capital == goal)
    reward = ((next_state == goal) & ~over[..., None]).astype(np.float64)
    initial = np.zeros(goal + 1)
    initial[1:goal] = summing_to_one(np.full(goal - 1, 1 / (goal - 1)))
    return TransitionModel(
        prob=np.broadcast_to([heads, 1 - heads], next_state.shape),
        next_state=next_state,
        reward=reward,
        terminated=(next_state == 0) | (next_state == goal),
        initial=initial if start is None else np.eye(goal + 1)[start],
    )
