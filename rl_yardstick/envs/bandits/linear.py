"""A contextual bandit whose expected rewards are linear in the context."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.envs import DEFAULT_PULLS
from rl_yardstick.envs.argument_checks import check_number, check_table
from rl_yardstick.envs.bandits.bandit import StochasticBandit, agreed_size


class LinearBandit(StochasticBandit):
    """Arms whose expected reward is a weighted sum of the observed features.

    ## Description
    Before each pull the agent sees a vector of features. Each arm has its own weights, and its
    expected reward is the sum of the features times the weights, as linear contextual bandits
    assume (Li et al., "A contextual-bandit approach to personalized news article recommendation",
    2010).

    ## Action Space
    `Discrete(n_arms)`: the arm to pull.

    ## Observation Space
    `Box(-1, 1, (n_features,), float32)`: the features.

    ## Rewards
    Normally distributed with the arm's expected reward and the standard deviation `reward_std`.

    ## Starting State
    Weights as given; else independent normal draws, anew in each episode, with mean 0 and variance
    3 / n_features, which gives expected rewards a variance of 1. The first features are drawn as
    all later ones, independently and uniformly from -1 to 1.

    ## Episode End
    When made by `gymnasium.make`, the episode is truncated after `pulls` steps, or after
    `max_episode_steps` where that is given.

    ## Information
    `step` gives, for the pull just made, `optimal_action`, the first of the best arms for the
    features; `expected_reward`, the mean of the arm pulled; `regret`, the best arm's mean minus
    that of the arm pulled; and `feedback_due`, always True. `reset` gives nothing.
    `reset` draws a standard normal number for each weight, those of arm 0 first, if they are not
    given. Each step draws one for the reward. Both then draw a uniform number u for each feature,
    which is 2 u - 1 in single precision. Expected rewards are summed from the first feature to the
    last in double precision.

    ## Arguments
    - `arm_parameters=None`: the weights, one row for each arm; None to draw them
    - `n_arms=None`, `n_features=None`: their numbers; 5, or those of `arm_parameters`
    - `reward_std=1`: standard deviation of the rewards
    - `pulls=1000`: the length of an episode
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    kind = "linear"
    context: NDArray[np.float32]

    def __init__(
        self,
        arm_parameters: Sequence[Sequence[float]] | None = None,
        n_arms: int | None = None,
        n_features: int | None = None,
        reward_std: float = 1,
        pulls: int = DEFAULT_PULLS,
        render_mode: str | None = None,
    ) -> None:
        given = None if arm_parameters is None else check_table("arm_parameters", arm_parameters)
        if given is not None and len(given) < 2:
            raise ValueError("arm_parameters must have two rows or more, one for each arm")
        rows, columns = (None, None) if given is None else given.shape
        shape = (
            agreed_size("n_arms", n_arms, rows, 5, 2),
            agreed_size("n_features", n_features, columns, 5, 1),
        )
        self.redraws = given is None
        self.arm_parameters = np.zeros(shape) if given is None else given
        self.reward_std = check_number("reward_std", reward_std, 0)
        self.n_features = shape[1]
        space = spaces.Box(-1, 1, (self.n_features,), np.float32)
        super().__init__(shape[0], space, pulls=pulls, render_mode=render_mode)
        self._see(np.full(self.n_features, 0.5))  # the context 0

    def expected_rewards(self) -> list[float]:
        return self._expected

    def _begin(self) -> None:
        if self.redraws:
            normals = self.np_random.standard_normal(self.arm_parameters.shape)
            self.arm_parameters = normals * math.sqrt(3 / self.n_features)
        self._see(self.np_random.random(self.n_features))

    def _pull(self, arm: int) -> float:
        reward = self._expected[arm] + self.reward_std * self.np_random.standard_normal()
        self._see(self.np_random.random(self.n_features))
        return reward

    def _see(self, uniforms: NDArray[np.float64]) -> None:
        """Set the context by numbers in [0, 1), shape (n_features,)."""
        self.context = context = (2 * uniforms - 1).astype(np.float32)
        # A cumulative sum adds in a fixed order, a matrix product in one that depends on the
        # machine: compiled copies could not repeat it to the last bit.
        sums = np.cumsum(self.arm_parameters * context, axis=1)
        self._expected: list[float] = sums[:, -1].tolist()
