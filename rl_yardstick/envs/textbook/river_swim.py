"""A river to swim up: a large reward is far up a strong current, a small one near."""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar

import numpy as np

from rl_yardstick.envs.argument_checks import check_number, check_whole_number
from rl_yardstick.envs.grid import ChainEnv
from rl_yardstick.mdp.transition_model import TransitionModel

MOST_STATES = 10_000
LEFT, RIGHT = 0, 1


class RiverSwimEnv(ChainEnv):
    """A swimmer goes against the current to a large reward, or with it to a small one.

    ## Description
    Strehl and Littman ("An analysis of model-based interval estimation for Markov decision
    processes", 2008), with the probabilities of Osband, Russo and Van Roy ("(More) efficient
    reinforcement learning via posterior sampling", 2013): six states in a row. Swimming left
    always succeeds. Swimming right moves up by one with probability .35 and down by one with .05,
    else it stays; in the leftmost state it moves up with .6, and in the rightmost one it stays with
    .6 and moves down with .4. Agents that explore too little never see the large reward.

    Always swimming right is optimal in the long run: it earns .4286 a step, always swimming left
    .005. Since a constant action is optimal, the score says little here: look at the gap.

    ## Action Space
    `Discrete(2)`: 0 left, with the current; 1 right, against it.

    ## Observation Space
    `Discrete(n_states)`: from left to right.

    ## Rewards
    - left in the leftmost state: .005
    - right in the rightmost state: 1

    ## Starting State
    The leftmost.

    ## Episode End
    It never terminates. It is truncated after 20 steps when made by `gymnasium.make`.

    ## Arguments
    - `n_states=6`: the length of the river
    - `left_reward=0.005`, `right_reward=1`: see Rewards
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    action_names: ClassVar[tuple[str, ...]] = ("left", "right")

    def __init__(
        self,
        n_states: int = 6,
        left_reward: float = 0.005,
        right_reward: float = 1,
        render_mode: str | None = None,
    ) -> None:
        self.n_states = check_whole_number("n_states", n_states, 2, MOST_STATES)
        self.left_reward = check_number("left_reward", left_reward)
        self.right_reward = check_number("right_reward", right_reward)
        super().__init__(self.n_states, 2, render_mode)

    def transition_model(self) -> TransitionModel:
        return _model(self.n_states, self.left_reward, self.right_reward)

    def letters(self) -> str:
        return "S".ljust(self.n_states - 1, ".") + "G"


@lru_cache(maxsize=4)
def _model(n: int, left_reward: float, right_reward: float) -> TransitionModel:
    prob = np.zeros((n, 2, 3))
    prob[:, LEFT] = 1, 0, 0
    prob[:, RIGHT] = 0.05, 0.6, 0.35
    prob[0, RIGHT] = 0, 0.4, 0.6
    prob[-1, RIGHT] = 0.4, 0.6, 0
    next_state = np.clip(np.arange(n)[:, None] + [-1, 0, 1], 0, n - 1)
    reward = np.zeros((n, 2))
    reward[0, LEFT], reward[-1, RIGHT] = left_reward, right_reward
    return TransitionModel(
        prob=prob,
        next_state=np.broadcast_to(next_state[:, None], prob.shape),
        reward=np.broadcast_to(reward[..., None], prob.shape),
        terminated=np.zeros(prob.shape, np.bool_),
        initial=np.eye(n)[0],
    )
