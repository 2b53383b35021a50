"""Contextual agents with a linear model of each arm's reward."""

from __future__ import annotations

from typing import Any, ClassVar, Unpack

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from agents.bandits import linear_rules
from agents.bandits.arguments import (
    CommonArguments,
    ExplorationDecay,
    LinearArguments,
    check_above_zero,
    check_at_least,
    check_epsilons,
    check_space,
)
from agents.bandits.base import BanditAlgorithm, Pull
from agents.bandits.linear_rules import LinearSettings
from agents.bandits.policy import LinearBanditPolicy, features
from agents.bandits.steps import choose_linear_arms, learn_linear_from
from agents.common.exploration import EPSILON_GREEDY
from agents.common.schedules import epsilon_schedule


class LinearBanditAgent(BanditAlgorithm):
    """An agent with a ridge regression for each arm; contexts that are numbers become one-hot.

    Args:
        policy: ``"LinearBanditPolicy"``.
        env: environment with `Box` observations of shape (d,) or `Discrete` ones, or its id.
        ridge: what the regressions start from, on the diagonal, above 0.
        kwargs: as in `BanditAlgorithm`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "LinearBanditPolicy": LinearBanditPolicy
    }
    policy: LinearBanditPolicy

    def __init__(
        self,
        policy: str | type[BasePolicy] = "LinearBanditPolicy",
        env: GymEnv | str | None = None,
        ridge: float = 1.0,
        **kwargs: Unpack[CommonArguments],
    ) -> None:
        self.ridge = ridge
        super().__init__(policy, env, **kwargs)

    @property
    def settings(self) -> LinearSettings:
        """What the compiled rules need to know of the agent."""
        return LinearSettings(self.rule, EPSILON_GREEDY, self.tie_scale, self._alpha())

    def _alpha(self) -> float:
        """How many standard deviations the agent looks around a prediction."""
        return 0.0

    def _check_arguments(self) -> None:
        space = self.observation_space
        if not (isinstance(space, spaces.Box) and len(space.shape) == 1):
            check_space(self, "observations of shape (d,) in a Box space or", space)
        check_above_zero([("ridge", self.ridge)])

    def _make_policy(self) -> LinearBanditPolicy:
        policy: Any = self.policy_class
        made: LinearBanditPolicy = policy(
            self.observation_space, self.action_space, self.lr_schedule, ridge=self.ridge
        )
        return made

    def _contexts(self, obs: NDArray[Any]) -> NDArray[np.float64]:
        return features(self.observation_space, obs)

    def _choose(
        self, contexts: NDArray[np.float64], rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        arms = choose_linear_arms(
            self.settings, self.policy.models, contexts, self.exploration_rate, rng
        )
        return arms, np.ones(len(arms))

    def _learn(self, pull: Pull) -> None:
        learn_linear_from(self.policy.models, pull.arm, np.array(pull.context), pull.reward)


class LinUCB(LinearBanditAgent):
    """Linear upper confidence bounds with disjoint models (Li et al., 2010).

    Args:
        policy: ``"LinearBanditPolicy"``.
        env: as in `LinearBanditAgent`.
        alpha: how many standard deviations the bound lies above the predicted reward.
        kwargs: as in `LinearBanditAgent`.
    """

    rule = linear_rules.LIN_UCB

    def __init__(
        self,
        policy: str | type[BasePolicy] = "LinearBanditPolicy",
        env: GymEnv | str | None = None,
        alpha: float = 1.0,
        **kwargs: Unpack[LinearArguments],
    ) -> None:
        self.alpha = alpha
        super().__init__(policy, env, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_at_least(0, [("alpha", self.alpha)])

    def _alpha(self) -> float:
        return self.alpha


class LinThompson(LinUCB):
    """Linear Thompson sampling (Agrawal and Goyal, 2013), with a model for each arm.

    Args:
        policy: ``"LinearBanditPolicy"``.
        env: as in `LinearBanditAgent`.
        alpha: scales the posterior's standard deviation; right is that of the rewards' noise.
        kwargs: as in `LinearBanditAgent`.
    """

    rule = linear_rules.LIN_THOMPSON


class LinEpsilonGreedy(LinearBanditAgent):
    """Epsilon-greedy in the predicted rewards.

    Args:
        policy: ``"LinearBanditPolicy"``.
        env: as in `LinearBanditAgent`.
        exploration_initial_eps: epsilon at the start.
        exploration_final_eps: epsilon at the end of ``exploration_fraction``.
        exploration_fraction: share of training over which epsilon falls.
        exploration_decay: how epsilon falls; ``"constant"`` stays at the initial value.
        kwargs: as in `LinearBanditAgent`.
    """

    rule = linear_rules.LIN_EPSILON_GREEDY

    def __init__(
        self,
        policy: str | type[BasePolicy] = "LinearBanditPolicy",
        env: GymEnv | str | None = None,
        exploration_initial_eps: float = 0.1,
        exploration_final_eps: float = 0.01,
        exploration_fraction: float = 1.0,
        exploration_decay: ExplorationDecay = "constant",
        **kwargs: Unpack[LinearArguments],
    ) -> None:
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_fraction = exploration_fraction
        self.exploration_decay = exploration_decay
        super().__init__(policy, env, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_epsilons(self)

    def _make_exploration_schedule(self) -> Schedule:
        return epsilon_schedule(
            self.exploration_decay,
            self.exploration_initial_eps,
            self.exploration_final_eps,
            self.exploration_fraction,
        )
