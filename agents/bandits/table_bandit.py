"""What the agents share that keep a score for each arm in each context."""

from __future__ import annotations

from typing import Any, ClassVar, Unpack, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.bandits.arguments import CommonArguments, check_space
from agents.bandits.base import BanditAlgorithm, Pull
from agents.bandits.policy import BanditPolicy
from agents.bandits.steps import choose_arms, learn_from
from agents.bandits.tables import Settings, Tables
from agents.common.exploration import EPSILON_GREEDY


class TableBandit(BanditAlgorithm):
    """An agent with a score for each arm in each context, run for each context on its own.

    Args:
        policy: ``"BanditPolicy"``.
        env: environment with `Discrete` observations, the contexts, or its id.
        ignore_context: one row for all contexts: what a pooled A/B test does.
        kwargs: as in `BanditAlgorithm`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"BanditPolicy": BanditPolicy}
    policy: BanditPolicy

    def __init__(
        self,
        policy: str | type[BasePolicy] = "BanditPolicy",
        env: GymEnv | str | None = None,
        ignore_context: bool = False,
        **kwargs: Unpack[CommonArguments],
    ) -> None:
        self.ignore_context = ignore_context
        super().__init__(policy, env, **kwargs)

    @property
    def initial_score(self) -> float:
        """Score of every arm at the start."""
        return 0.0

    @property
    def settings(self) -> Settings:
        """What the compiled rules need to know of the agent."""
        return Settings(self.rule, EPSILON_GREEDY, False, self.tie_scale, self._parameters())

    def _parameters(self) -> tuple[float, float, float]:
        """The numbers that the agent's rule takes."""
        return 0.0, 0.0, 0.0

    def _check_arguments(self) -> None:
        check_space(self, "observations", self.observation_space)

    def _make_policy(self) -> BanditPolicy:
        n_observations = int(cast(spaces.Discrete, self.observation_space).n)
        policy: Any = self.policy_class
        made: BanditPolicy = policy(
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            n_contexts=1 if self.ignore_context else n_observations,
            initial_score=self.initial_score,
        )
        return made

    def _contexts(self, obs: NDArray[Any]) -> NDArray[np.int64]:
        rows = obs.astype(np.int64).reshape(-1)
        return np.zeros_like(rows) if self.ignore_context else rows

    def _choose(
        self, contexts: NDArray[np.int64], rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        return choose_arms(self.settings, self.policy.tables, contexts, self.exploration_rate, rng)

    def _learn(self, pull: Pull) -> None:
        rate = self.lr_schedule(self._current_progress_remaining)
        learn_from(self.settings, self.policy.tables, *pull, rate)

    def estimates(self, tables: Tables) -> NDArray[np.float64]:
        """What the agent takes the arms' mean rewards for, shapes (..., contexts, arms)."""
        return tables.scores
