"""Bandits whose arms give a reward of 1 or 0: coins, and the treatments of an A/B test."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium import spaces

from rl_yardstick.envs import DEFAULT_PULLS
from rl_yardstick.envs.argument_checks import check_numbers, check_table
from rl_yardstick.envs.bandits.bandit import StochasticBandit
from rl_yardstick.envs.finite_env import first_above
from rl_yardstick.mdp.transition_model import Floats, TransitionModel

# How far probabilities of segments may be from summing to one.
TOLERANCE = 1e-9


class ClickBandit(StochasticBandit):
    """Arms with a click rate in each of finitely many contexts.

    As `envs.grid.GridWorld`, `reset` and `step` draw one uniform number each and choose by
    cumulative sum, so that the arrays of `transition_model` replay an episode exactly. Rates have
    the shape (n_contexts, n_arms).
    """

    kind = "clicks"
    context: int

    def __init__(
        self,
        context_probabilities: Floats,
        click_rates: Floats,
        *,
        pulls: int,
        batch_size: int = 1,
        render_mode: str | None,
    ) -> None:
        n_contexts, n_arms = click_rates.shape
        space = spaces.Discrete(n_contexts)
        super().__init__(n_arms, space, pulls=pulls, batch_size=batch_size, render_mode=render_mode)
        self.means = click_rates
        self.context_probabilities = context_probabilities
        self.context_cumulative = np.cumsum(context_probabilities)
        # A click and then context 0, 1, ...; no click and then context 0, 1, ...
        outcomes = np.stack((click_rates, 1 - click_rates), axis=2)[..., None]
        self._outcome_prob = (outcomes * context_probabilities).reshape(n_contexts, n_arms, -1)
        self.outcome_cumulative = np.cumsum(self._outcome_prob, axis=2)
        # Lists, since `step` looks up single numbers.
        self._expected: list[list[float]] = click_rates.tolist()
        self._context_thresholds: list[float] = self.context_cumulative.tolist()
        self._thresholds: list[list[list[float]]] = self.outcome_cumulative.tolist()
        self.context = 0

    @property
    def s(self) -> int:
        """The context, under the name that toy_text gives the state; may be set."""
        return self.context

    @s.setter
    def s(self, context: int) -> None:
        self.context = context

    def expected_rewards(self) -> list[float]:
        return self._expected[self.context]

    def transition_model(self) -> TransitionModel:
        """The exact dynamics as arrays, contexts being states."""
        shape = self._outcome_prob.shape
        outcome = np.arange(shape[-1])
        return TransitionModel(
            prob=self._outcome_prob,
            next_state=np.broadcast_to(outcome % len(self.means), shape),
            reward=np.broadcast_to((outcome < len(self.means)).astype(np.float64), shape),
            terminated=np.zeros(shape, np.bool_),
            initial=self.context_probabilities,
        )

    def _true_means(self) -> Floats:
        return self.means

    def _begin(self) -> None:
        self.context = first_above(self._context_thresholds, self.np_random.random())

    def _pull(self, arm: int) -> float:
        outcome = first_above(self._thresholds[self.context][arm], self.np_random.random())
        clicked, self.context = divmod(outcome, len(self._expected))
        return 1.0 - clicked


class BernoulliBandit(ClickBandit):
    """Arms that give 1 with a probability of their own, and 0 otherwise.

    ## Description
    Each arm is a coin. The agent has to find out by pulling which one comes up heads most often.

    ## Action Space
    `Discrete(n_arms)`: the arm to pull.

    ## Observation Space
    `Discrete(1)`: there is nothing to see.

    ## Rewards
    1 with the arm's probability, else 0.

    ## Starting State
    The only one.

    ## Episode End
    When made by `gymnasium.make`, the episode is truncated after `pulls` steps, or after
    `max_episode_steps` where that is given.

    ## Information
    `step` gives, for the pull just made, `optimal_action`, the first of the best arms;
    `expected_reward`, the mean of the arm pulled; `regret`, the best arm's mean minus that of the
    arm pulled; and `feedback_due`, always True. `reset` gives nothing.
    One uniform number is drawn by `reset`, without effect, and one by each step: the reward is 1 if
    it lies below the arm's probability.

    ## Arguments
    - `probabilities=(0.2, 0.5, 0.75)`: of the arms, two or more
    - `pulls=1000`: the length of an episode
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    def __init__(
        self,
        probabilities: Sequence[float] = (0.2, 0.5, 0.75),
        pulls: int = DEFAULT_PULLS,
        render_mode: str | None = None,
    ) -> None:
        rates = np.array([check_numbers("probabilities", probabilities, 0, 1)])
        super().__init__(np.ones(1), rates, pulls=pulls, render_mode=render_mode)


class SegmentBandit(ClickBandit):
    """An A/B test: users of several segments, and treatments that they click on or not.

    ## Description
    Each user belongs to a known segment, and is shown one of the treatments. A treatment that works
    for one segment need not work for another. With the default figures, in the style of Li et al.
    ("A contextual-bandit approach to personalized news article recommendation", 2010), 30 % of the
    users are core users and 70 % casual ones:

    | segment | treatment 0 | treatment 1 | treatment 2 |
    |---|---|---|---|
    | 0 core | .10 | .25 | .05 |
    | 1 casual | .12 | .06 | .05 |

    The best single treatment for everybody is treatment 1, with .117 clicks per user. By segment,
    .159 can be reached.

    ## Action Space
    `Discrete(n_arms)`: the treatment to show.

    ## Observation Space
    `Discrete(n_segments)`: the segment of the user.

    ## Rewards
    1 if the user clicks, else 0.

    ## Starting State
    The first user's segment, drawn by `segment_probabilities` as every later one's.

    ## Episode End
    When made by `gymnasium.make`, the episode is truncated after `pulls` steps, or after
    `max_episode_steps` where that is given.

    ## Information
    `step` gives, for the pull just made, `optimal_action`, the first of the best treatments for the
    segment; `expected_reward`, the click rate of the treatment shown; `regret`, the best
    treatment's click rate minus that one; and `feedback_due`. `reset` gives nothing.

    Feedback arrives in batches: `feedback_due` is True on each `batch_size`-th pull and on the last
    of the episode. The reward that `step` returns is always that pull's own, so that returns,
    monitors and regret are right whatever the batch; but an agent may learn from the rewards of a
    batch only once feedback is due, or the episode over. The bandit agents do so. Agents that know
    nothing of batches, such as DQN, learn as if `batch_size` were 1.

    `reset` and `step` draw one uniform number each, and choose by cumulative sum: `reset` the
    segment; `step` click and next segment together, from the outcomes in the order of
    `transition_model()`.

    ## Arguments
    - `segment_probabilities=(0.3, 0.7)`: shares of the segments, summing to 1
    - `click_rates=((0.10, 0.25, 0.05), (0.12, 0.06, 0.05))`: one row for each segment, one column
      for each treatment
    - `batch_size=1`: after how many pulls feedback arrives
    - `pulls=1000`: the length of an episode
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    def __init__(
        self,
        segment_probabilities: Sequence[float] = (0.3, 0.7),
        click_rates: Sequence[Sequence[float]] = ((0.10, 0.25, 0.05), (0.12, 0.06, 0.05)),
        batch_size: int = 1,
        pulls: int = DEFAULT_PULLS,
        render_mode: str | None = None,
    ) -> None:
        shares = np.array(check_numbers("segment_probabilities", segment_probabilities, 0, 1, 1))
        if abs(shares.sum() - 1) > TOLERANCE:
            raise ValueError(f"segment_probabilities must sum to 1, not to {shares.sum():g}")
        rates = check_table("click_rates", click_rates, 0, 1)
        if len(rates) != len(shares):
            raise ValueError(
                f"click_rates must have a row for each segment: {len(shares)}, not {len(rates)}"
            )
        if rates.shape[1] < 2:
            raise ValueError("click_rates must have a column for each treatment, two or more")
        super().__init__(shares, rates, pulls=pulls, batch_size=batch_size, render_mode=render_mode)
