"""Two states in which Q-learning overestimates values."""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar

import numpy as np

from rl_yardstick.envs.argument_checks import check_number, check_whole_number
from rl_yardstick.envs.finite_env import MaskedFiniteEnv
from rl_yardstick.envs.grid import ChainEnv
from rl_yardstick.mdp.transition_model import Bools, TransitionModel

MOST_ACTIONS = 1000
# B to the left of A, and an end beyond either.
LEFT_END, B, A, RIGHT_END = range(4)


class MaximizationBiasEnv(ChainEnv, MaskedFiniteEnv):
    """To the right no reward, to the left many actions that lose a little and often seem to win.

    ## Description
    Sutton and Barto (Reinforcement Learning, 2nd edition), example 6.7: an episode begins in A.
    Right ends it with a reward of 0. Left leads to B, from where each of many actions ends it with
    a reward that is normally distributed around -0.1. The largest of many estimates is too high, so
    that Q-learning goes left far more often than it should; double Q-learning does not.

    Right is optimal, at 0. Always going right earns as much without any learning, so the score says
    little here: what counts is how often an agent goes left while it learns.

    ## Action Space
    `Discrete(n_actions)`. In A, 0 is left and 1 is right; there `action_masks()` allows these two.
    An agent without masks may choose others: even ones are left, odd ones right. In B all are
    alike.

    ## Observation Space
    `Discrete(4)`: 1 is B and 2 is A; 0 the end after B, 3 the end to the right.

    ## Rewards
    0 for both actions in A. Each action in B: normally distributed, with mean -0.1 and standard
    deviation 1.

    ## Starting State
    A.

    ## Episode End
    The episode terminates after right, or after any action in B: two steps at most. The limit of
    100 steps that `gymnasium.make` sets is never reached.

    ## Information
    `reset` and `step` give nothing more. Each draws one uniform number, without effect; a step in B
    then a standard normal one for the reward.
    The dynamics are available as arrays from `transition_model()`, and as `P` and
    `initial_state_distrib` as in Gymnasium's FrozenLake. Rewards in them are means; the arrays hold
    their variance too.

    ## Arguments
    - `n_actions=10`: the number of actions
    - `reward_mean=-0.1`, `reward_std=1`: of the rewards in B
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    action_names: ClassVar[tuple[str, ...]] = tuple(f"action {i}" for i in range(MOST_ACTIONS))

    def __init__(
        self,
        n_actions: int = 10,
        reward_mean: float = -0.1,
        reward_std: float = 1,
        render_mode: str | None = None,
    ) -> None:
        self.n_actions = check_whole_number("n_actions", n_actions, 2, MOST_ACTIONS)
        self.reward_mean = check_number("reward_mean", reward_mean)
        self.reward_std = check_number("reward_std", reward_std, 0)
        super().__init__(4, self.n_actions, render_mode)

    def transition_model(self) -> TransitionModel:
        return _model(self.n_actions, self.reward_mean, self.reward_std)

    def masks_of_states(self) -> Bools:
        masks = np.ones((4, self.n_actions), np.bool_)
        masks[A, 2:] = False
        return masks

    def letters(self) -> str:
        return "G.SG"


@lru_cache(maxsize=4)
def _model(n: int, reward_mean: float, reward_std: float) -> TransitionModel:
    shape = (4, n, 1)
    next_state = np.zeros(shape, np.int64)
    next_state[RIGHT_END] = RIGHT_END
    next_state[A, :, 0] = np.where(np.arange(n) % 2 == 0, B, RIGHT_END)
    reward = np.zeros(shape)
    reward[B] = reward_mean
    return TransitionModel(
        prob=np.ones(shape),
        next_state=next_state,
        reward=reward,
        terminated=next_state != B,
        initial=np.eye(4)[A],
        reward_variance=reward_std**2 * (np.arange(4) == B)[:, None, None] * np.ones(shape),
    )
