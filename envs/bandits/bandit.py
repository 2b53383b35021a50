"""What bandits share: counting pulls, rendering, and what `step` tells where arms are known."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from gymnasium import spaces

from envs.argument_checks import check_whole_number
from envs.bandit_rendering import Tally, render_chart, render_text
from envs.rendering import ChartRenderer
from envs.scene import Chart
from envs.shown_env import ShownEnv
from mdp.array_types import Floats

MAX_PULLS = 10**9
MAX_ARMS = 10_000


class Bandit(ShownEnv):
    """Arms to pull, one a step, in the present context.

    A subclass says with `_begin` how an episode begins, with `step` what a pull gives, and with
    `_true_means` what is known of the arms.

    Args:
        n_arms: the number of arms.
        observation_space: of the contexts.
        pulls: the length of an episode; the time limit that `gymnasium.make` sets.
        batch_size: after how many pulls feedback comes in, see `step`.
        render_mode: ``"ansi"``, ``"rgb_array"``, ``"human"`` or None.

    Attributes:
        kind: the dynamics' name, by which compiled copies know them.
        context: what the agent observes before the next pull.
        pulls_done: pulls of this episode.

    Raises:
        ValueError: if an argument is out of range.
    """

    kind: str
    context: Any

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
        self.pulls_done = 0
        self._tally = Tally.empty(max(self.n_contexts, 1), n_arms)

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
            self._tally = Tally.empty(max(self.n_contexts, 1), self.n_arms)
        if self.render_mode == "human":
            self.render()
        return self.context, {}

    def _text(self) -> str:
        return render_text(self._tally, self._true_means(), self._row(self.context))

    def _picture(self) -> Chart:
        return render_chart(self._tally, self._true_means(), self._row(self.context))

    def _make_renderer(self, fps: int, title: str) -> ChartRenderer:
        return ChartRenderer(fps, title)

    def _checked(self, action: int) -> int:
        """The arm that an action names."""
        arm = int(action)
        if not 0 <= arm < self.n_arms:
            raise ValueError(f"arm {arm} does not exist: they are numbered 0 to {self.n_arms - 1}")
        return arm

    def _row(self, context: Any) -> int:
        """Which row of the tally a context counts to: its own, or the only one."""
        return int(context) if self.n_contexts else 0

    def _show_pull(self, context: Any, arm: int, reward: float) -> None:
        """Remember a pull for the next picture, and draw it where there is a window."""
        if self.render_mode is not None:
            self._tally.add(self._row(context), arm, reward)
        if self.render_mode == "human":
            self.render()

    @abstractmethod
    def _true_means(self) -> Floats | None:
        """What each arm gives on average, one row for each of the tally's; None if not known."""

    @abstractmethod
    def _begin(self) -> None:
        """Make ready for the first pull of an episode."""


class StochasticBandit(Bandit):
    """Arms whose rewards are drawn, each with an expected one in the present context.

    A subclass says with `_begin` how arms and first context are drawn, with `expected_rewards`
    what each arm is worth in the context, and with `_pull` what reward it gives and which context
    comes next. Its docstring lists the random numbers in the order in which it draws them: compiled
    copies draw the same ones.
    """

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Pull an arm; see the class for the meaning of what is returned.

        Raises:
            ValueError: if there is no such arm.
        """
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
        """What each arm gives on average in the present context."""

    @abstractmethod
    def _pull(self, arm: int) -> float:
        """Draw the reward of an arm, and the next context."""

    def _true_means(self) -> Floats | None:
        return np.array([self.expected_rewards()])


def agreed_size(name: str, asked: int | None, given: int | None, default: int, low: int) -> int:
    """How many there are: as many as are given, else as are asked for, else the default.

    Raises:
        ValueError: if what is asked for is out of range, or not what is given.
    """
    if asked is None:
        return default if given is None else given
    size = check_whole_number(name, asked, low, MAX_ARMS)
    if given not in {None, size}:
        raise ValueError(f"{name} is {size}, but {given} are given: leave it out")
    return size
