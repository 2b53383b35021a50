"""The random walk, for comparing methods that estimate values."""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar

import numpy as np

from rl_yardstick.envs.argument_checks import check_number, check_whole_number
from rl_yardstick.envs.finite_env import summing_to_one
from rl_yardstick.envs.grid import ChainEnv
from rl_yardstick.mdp.transition_model import TransitionModel

MOST_STATES = 10_000
MOST_OUTCOMES = 20_000_000


class RandomWalkEnv(ChainEnv):
    """A random walk to the left or to the right: the values of its states are to be estimated.

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), example 6.2: states 1 to 5 in a row.
    Each step goes to one of the neighbours, to both with equal probability, until it leaves the row
    at either end. Ending on the right earns 1, so the value of state i is i / 6.

    There is only one action, so an agent does not control, it predicts. Q-learning is TD(0) here,
    and all agents earn the same.

    - Example 7.1: `n_states=19, left_reward=-1`; the value of state i is (i - 10) / 10.
    - Example 9.1: `n_states=1000, max_jump=100, left_reward=-1`: a step jumps to any of the 100
      states on either side; a jump beyond an end terminates there.

    ## Action Space
    `Discrete(1)`: 0 takes a step.

    ## Observation Space
    `Discrete(n_states + 2)`: the states 1 to `n_states` from left to right; 0 beyond the left end
    and `n_states + 1` beyond the right one.

    ## Rewards
    1 for leaving on the right, 0 for everything else.

    ## Starting State
    The one in the middle, `(n_states + 1) // 2`.

    ## Episode End
    The episode terminates beyond either end. It is truncated after 1000 steps when made by
    `gymnasium.make`; the values above are those without a limit.

    ## Arguments
    - `n_states=5`: the length of the row
    - `max_jump=1`: a step goes 1 to this many states to the left or to the right, to each with
      equal probability
    - `left_reward=0`, `right_reward=1`: for leaving on that side
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    action_names: ClassVar[tuple[str, ...]] = ("step",)

    def __init__(
        self,
        n_states: int = 5,
        max_jump: int = 1,
        left_reward: float = 0,
        right_reward: float = 1,
        render_mode: str | None = None,
    ) -> None:
        self.n_states = check_whole_number("n_states", n_states, 1, MOST_STATES)
        self.max_jump = check_whole_number("max_jump", max_jump, 1, MOST_STATES)
        if 2 * self.n_states * self.max_jump > MOST_OUTCOMES:
            raise ValueError(
                f"n_states {n_states} with max_jump {max_jump} is too much: twice their product "
                f"may be at most {MOST_OUTCOMES:,}"
            )
        self.left_reward = check_number("left_reward", left_reward)
        self.right_reward = check_number("right_reward", right_reward)
        super().__init__(self.n_states + 2, 1, render_mode)

    def transition_model(self) -> TransitionModel:
        return _model(self.n_states, self.max_jump, self.left_reward, self.right_reward)

    def letters(self) -> str:
        middle = "." * ((self.n_states + 1) // 2 - 1)
        return f"G{middle}S".ljust(self.n_states + 1, ".") + "G"


@lru_cache(maxsize=4)
def _model(n: int, max_jump: int, left: float, right: float) -> TransitionModel:
    jumps = np.concatenate([np.arange(-max_jump, 0), np.arange(1, max_jump + 1)])
    states = np.arange(n + 2)[:, None]
    ends = (states == 0) | (states == n + 1)
    next_state = np.clip(states + np.where(ends, 0, jumps), 0, n + 1)
    terminated = (next_state == 0) | (next_state == n + 1)
    reward = np.where(next_state == 0, left, right) * (terminated & ~ends)
    prob = summing_to_one(np.full(next_state.shape, 1 / len(jumps)))
    return TransitionModel(
        prob=prob[:, None],
        next_state=next_state[:, None],
        reward=reward[:, None],
        terminated=terminated[:, None],
        initial=np.eye(n + 2)[(n + 1) // 2],
    )
