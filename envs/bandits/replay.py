"""A policy tried on pulls that were logged before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from envs.bandits.bandit import Bandit
from envs.bandits.logged_data import LoggedData, read_log

# By what part a propensity may differ from one in so many arms: files round.
TOLERANCE = 0.02


class ReplayBandit(Bandit):
    """Logged pulls, of which those count that chose the same arm.

    ## Description
    What would another policy have earned on the users of a log? If the log chose its arms uniformly
    at random, replay answers without bias: go through the log, let the policy choose for each
    context, and count the rows where it chooses the logged arm, because only there the reward is
    known (Li, Chu, Langford and Wang, "Unbiased offline evaluation of contextual-bandit-based news
    article recommendation algorithms", 2011). About one row in `n_arms` counts. The policy's mean
    reward is estimated by the return divided by `matched_pulls`.

    ## Action Space
    `Discrete(n_arms)`: the arm to pull; there are as many as the propensities say.

    ## Observation Space
    `Discrete(1)` if the log has no context; `Discrete(n)` if its context is one column of text, or
    one that holds every whole number from 0 to n - 1; else `Box` with a float32 for each column.
    Text is numbered in alphabetical order.

    ## Rewards
    The logged reward where the arm is the logged one; otherwise 0.

    ## Starting State
    The context of the first row.

    ## Episode End
    The episode is truncated after the last row, or after `max_episode_steps` where that is given
    to `gymnasium.make`.

    ## Information
    `step` gives `matched`, whether the arm was the logged one; `matched_pulls`, how often that has
    been so in this episode; and `feedback_due`, always True. `reset` gives nothing. The best arm is
    not known, so there is no regret.

    If `matched` is False, the row says nothing, and an agent must not learn from it. The bandit
    agents skip it. Other agents, such as DQN, learn from the reward of 0. With uniform logging this
    divides their estimate for each arm by `n_arms`, and does not change the order of the arms. No
    random numbers are drawn.

    ## Arguments
    - `log`: the path to a CSV file with the columns `arm`, `reward` and `propensity`, and one for
      each part of the context; see `envs.bandits.logged_data`. Every propensity must be one in
      `n_arms`, within 2 %.
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`

    ## Version History
    - v0: the first version
    """

    kind = "replay"

    def __init__(self, log: str | Path | None = None, render_mode: str | None = None) -> None:
        if not isinstance(log, str | Path):
            raise ValueError(f"log must be the path to a CSV file of logged pulls, not {log!r}")
        data = read_log(log)
        n_arms = _number_of_arms(data)
        super().__init__(n_arms, data.observation_space, pulls=len(data), render_mode=render_mode)
        self.data = data
        observations = data.observations(data.observation_space)
        self._contexts = observations.tolist() if observations.ndim == 1 else list(observations)
        self.matched_pulls = 0
        self.context = self._contexts[0]

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Choose an arm for the context of the present row.

        Raises:
            ValueError: if there is no such arm, or no row left.
        """
        arm, row = self._checked(action), self.pulls_done
        if row == self.pulls:
            raise ValueError(f"{self.data.source} has {self.pulls} rows: call reset after the last")
        self.pulls_done += 1
        matched = arm == int(self.data.arms[row])
        self.matched_pulls += matched
        reward = float(self.data.rewards[row]) if matched else 0.0
        before = self.context
        # After the last row there is no context any more: it stays.
        self.context = self._contexts[min(self.pulls_done, self.pulls - 1)]
        info = {
            "matched": matched,
            "matched_pulls": self.matched_pulls,
            "feedback_due": True,
        }
        if matched:
            self._show_pull(before, arm, reward)
        return self.context, reward, False, self.pulls_done == self.pulls, info

    def _true_means(self) -> None:
        return None

    def _begin(self) -> None:
        self.matched_pulls = 0
        self.context = self._contexts[0]


def _number_of_arms(data: LoggedData) -> int:
    """How many arms a uniform log chose from.

    Raises:
        ValueError: if it did not choose uniformly, or does not say how it did.
    """
    if data.propensities is None:
        raise ValueError(
            f"{data.source} has no column 'propensity': replay needs one, each value the "
            "probability with which the arm was chosen"
        )
    n_arms = max(data.n_arms, round(1 / float(np.median(data.propensities))), 2)
    wrong = np.flatnonzero(np.abs(data.propensities * n_arms - 1) > TOLERANCE)
    if len(wrong):
        raise ValueError(
            f"{data.source} did not choose among its {n_arms} arms uniformly: the propensity of "
            f"pull {wrong[0] + 1} is {data.propensities[wrong[0]]:g}, not {1 / n_arms:.4g}; use "
            f"inverse propensities instead: compare --logged {data.source} --policy RUN"
        )
    return n_arms
