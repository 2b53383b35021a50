"""The base classes of bandits: counts of pulls, the ``info`` of `step`, and rendering."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from gymnasium import spaces

from rl_yardstick.envs.argument_checks import check_whole_number
from rl_yardstick.envs.drawing import Bar, Bars, ShownEnv
from rl_yardstick.mdp.transition_model import Floats, Ints

# At most so many arms are shown, those of the contexts around the present one.
MAX_SHOWN = 24
MAX_PULLS = 10**9
MAX_ARMS = 10_000


class Bandit(ShownEnv):
    """Arms to pull, one a step, in the present context.

    A subclass defines the start of an episode in `_begin`, a pull in `step`, and the known means of
    the arms in `_true_means`. `gymnasium.make` makes ``pulls`` the time limit.
    """

    kind: str  # the kind of dynamics, which selects the compiled copy
    context: Any  # what the agent observes before the next pull

    def __init__(
        self,
        n_arms: int,
        observation_space: spaces.Space[Any],
        *,
        pulls: int,
        batch_size: int = 1,
        render_mode: str | None,
    ) -> None:
        super().__init__(render_mode)
        self.n_arms = n_arms
        self.pulls = check_whole_number("pulls", pulls, 1, MAX_PULLS)
        self.batch_size = check_whole_number("batch_size", batch_size, 1, MAX_PULLS)
        self.observation_space = observation_space
        self.action_space = spaces.Discrete(n_arms)
        self.pulls_done = 0  # in this episode
        self._forget_pulls()

    def _forget_pulls(self) -> None:
        shape = max(self.n_contexts, 1), self.n_arms
        # By context and arm, for rendering: the number of pulls, and the sums of their rewards.
        self._counts: Ints = np.zeros(shape, np.int64)
        self._sums: Floats = np.zeros(shape)
        self._last: tuple[int, int, float] | None = None  # context, arm and reward

    @property
    def n_contexts(self) -> int:
        """The number of contexts; 0 where they are vectors."""
        space = self.observation_space
        return int(space.n) if isinstance(space, spaces.Discrete) else 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; ``options`` are not used."""
        super().reset(seed=seed)
        self.pulls_done = 0
        self._begin()
        if self.render_mode is not None:
            self._forget_pulls()
        if self.render_mode == "human":
            self.render()
        return self.context, {}

    def _picture(self) -> Bars:
        """A bar for each arm up to its observed mean, marked at its true mean."""
        means = self._sums / np.maximum(self._counts, 1)
        true, present = self._true_means(), int(self.context) if self.n_contexts else 0
        n_arms = min(self.n_arms, MAX_SHOWN)
        n_contexts = min(MAX_SHOWN // n_arms, len(means))
        first = max(0, min(present - n_contexts // 2, len(means) - n_contexts))
        bars = []
        for context, arm in np.ndindex(n_contexts, n_arms):
            at = first + context, arm
            name, pulls = f"arm {arm}", int(self._counts[at])
            if len(means) > 1:
                name = f"context {at[0]}{' (next)' if at[0] == present else ''}, {name}"
            observed = f"{means[at]:8.3f}" if pulls else f"{'-':>8}"
            known = "" if true is None else f", true now {true[at]:.3f}"
            bars.append(
                Bar(
                    name,
                    float(means[at]) if pulls else None,
                    f"{pulls:6} pulls, mean{observed}{known}",
                    None if true is None else float(true[at]),
                    self._last is not None and self._last[:2] == at,
                )
            )
        title = "no pull yet"
        if self._last is not None:
            title = f"pull {self._counts.sum()}: arm {self._last[1]}, reward {self._last[2]:.4g}"
        return Bars.fitting(title, bars, [*means.flat, *([] if true is None else true.flat)])

    def _checked(self, action: int) -> int:
        """The arm that an action names."""
        arm = int(action)
        if not 0 <= arm < self.n_arms:
            raise ValueError(f"arm {arm} does not exist: they are numbered 0 to {self.n_arms - 1}")
        return arm

    def _show_pull(self, context: Any, arm: int, reward: float) -> None:
        """Record a pull for the next picture, and render it in mode ``human``."""
        if self.render_mode is not None:
            self._last = at = int(context) if self.n_contexts else 0, arm, reward
            self._counts[at[:2]] += 1
            self._sums[at[:2]] += reward
        if self.render_mode == "human":
            self.render()

    def _true_means(self) -> Floats | None:
        """The mean reward of each arm, shape (n_contexts, n_arms); None if not known."""
        return None

    @abstractmethod
    def _begin(self) -> None:
        """Prepare the first pull of an episode."""


class StochasticBandit(Bandit):
    """Arms with random rewards, each with an expected reward in the present context.

    A subclass draws the arms and the first context in `_begin`, returns the expected reward of each
    arm in the context from `expected_rewards`, and draws a reward and the next context in `_pull`.
    Its docstring lists the random numbers in the order in which it draws them: compiled copies draw
    the same ones.
    """

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Pull an arm; the class describes the results."""
        arm = self._checked(action)
        expected = self.expected_rewards()
        best = max(expected)
        self.pulls_done += 1
        before = self.context
        reward = self._pull(arm)
        info = {
            "optimal_action": expected.index(best),
            "expected_reward": expected[arm],
            "regret": best - expected[arm],
            "feedback_due": self.pulls_done % self.batch_size == 0 or self.pulls_done == self.pulls,
        }
        self._show_pull(before, arm, reward)
        return self.context, reward, False, False, info

    @abstractmethod
    def expected_rewards(self) -> list[float]:
        """The expected reward of each arm in the present context."""

    @abstractmethod
    def _pull(self, arm: int) -> float:
        """Draw the reward of an arm, and the next context."""

    def _true_means(self) -> Floats | None:
        return np.array([self.expected_rewards()])


def agreed_size(name: str, asked: int | None, given: int | None, default: int, low: int) -> int:
    """The size ``given`` by other arguments, else ``asked``, else the default; they must agree."""
    if asked is None:
        return default if given is None else given
    size = check_whole_number(name, asked, low, MAX_ARMS)
    if given not in {None, size}:
        raise ValueError(f"{name} is {size}, but {given} are given: leave it out")
    return size
