"""The ten-armed testbed and variants of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium import spaces

from rl_yardstick.envs import DEFAULT_PULLS
from rl_yardstick.envs.argument_checks import check_number, check_numbers
from rl_yardstick.envs.bandits.bandit import StochasticBandit, agreed_size
from rl_yardstick.mdp.transition_model import Floats


class GaussianBandit(StochasticBandit):
    """Arms with normally distributed rewards, whose means may drift.

    ## Description
    By default the ten-armed testbed (Sutton and Barto, Reinforcement Learning, 2nd edition, section
    2.3): a new problem in each episode, the means of its arms drawn from a normal distribution. The
    best possible mean reward is then 1.5388 on average. With `means` and `drift_std` it is the
    non-stationary problem of exercise 2.5: `means=[0, 0, 0, 0, 0, 0, 0, 0, 0, 0], drift_std=0.01`.

    ## Action Space
    `Discrete(n_arms)`: the arm to pull.

    ## Observation Space
    `Discrete(1)`: there is nothing to see.

    ## Rewards
    Normally distributed with the mean of the arm and the standard deviation `reward_std`.

    ## Starting State
    The means, where they are given; else independent normal draws with mean `mean_loc` and
    standard deviation 1, anew in each episode.

    ## Episode End
    When made by `gymnasium.make`, the episode is truncated after `pulls` steps, or after
    `max_episode_steps` where that is given.

    ## Information
    `step` gives, for the pull just made and by the means before they drift, `optimal_action`, the
    first of the best arms; `expected_reward`, the mean of the arm pulled; `regret`, the best arm's
    mean minus that of the arm pulled; and `feedback_due`, always True. `reset` gives nothing.
    `reset` draws one standard normal number for each arm if means are not given, else nothing. Each
    step draws one for the reward; and then, if `drift_std` is not 0, one for each arm.

    ## Arguments
    - `means=None`: of the arms, two or more; None to draw them
    - `n_arms=None`: how many there are; 10, or as many as there are means
    - `mean_loc=0`: the mean of the means that are drawn
    - `reward_std=1`: standard deviation of the rewards
    - `drift_std=0`: standard deviation of the step that every mean takes after each pull
    - `pulls=1000`: the length of an episode
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    kind = "gaussian"
    context: int

    def __init__(
        self,
        means: Sequence[float] | None = None,
        n_arms: int | None = None,
        mean_loc: float = 0,
        reward_std: float = 1,
        drift_std: float = 0,
        pulls: int = DEFAULT_PULLS,
        render_mode: str | None = None,
    ) -> None:
        self.given_means = None if means is None else check_numbers("means", means)
        given = None if self.given_means is None else len(self.given_means)
        n_arms = agreed_size("n_arms", n_arms, given, 10, 2)
        self.mean_loc = check_number("mean_loc", mean_loc)
        if self.given_means is not None and self.mean_loc != 0:
            raise ValueError("mean_loc is for means that are drawn, but means are given")
        self.reward_std = check_number("reward_std", reward_std, 0)
        self.drift_std = check_number("drift_std", drift_std, 0)
        super().__init__(n_arms, spaces.Discrete(1), pulls=pulls, render_mode=render_mode)
        self.context = 0
        self.redraws = self.given_means is None  # whether each episode has means of its own
        self._means = list(self.given_means or [self.mean_loc] * n_arms)

    @property
    def means(self) -> Floats:
        """The means as they are now, shape (1, n_arms)."""
        return np.array([self._means])

    def expected_rewards(self) -> list[float]:
        return self._means

    def _begin(self) -> None:
        if self.given_means is None:
            self._means = [self.mean_loc + normal for normal in self._normals()]
        else:
            self._means = list(self.given_means)

    def _pull(self, arm: int) -> float:
        reward = self._means[arm] + self.reward_std * self.np_random.standard_normal()
        if self.drift_std > 0:
            steps = self._normals()
            self._means = [
                mean + self.drift_std * step for mean, step in zip(self._means, steps, strict=True)
            ]
        return reward

    def _normals(self) -> list[float]:
        """A standard normal number for each arm."""
        numbers: list[float] = self.np_random.standard_normal(self.n_arms).tolist()
        return numbers
