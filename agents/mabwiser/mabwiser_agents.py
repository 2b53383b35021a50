"""MABWiser's bandits behind the interface of ours, to compare with (extra ``bandits``)."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, Unpack

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.bandits import reward_checks
from agents.bandits.bandit_algorithm import BanditAlgorithm, Pull
from agents.bandits.linear_policy import features
from agents.common.setting_checks import check_at_least, check_share, check_space, settings_of
from agents.common.signatures import CommonArguments, LearningArguments, TieBreaking
from agents.mabwiser.mabwiser_policy import MABWiserPolicy
from mdp.array_types import Floats, Ints

SUMS = ("arm_to_sum", "arm_to_count", "arm_to_expectation")


class MABWiserAgent(BanditAlgorithm):
    """The base of the agents that MABWiser learns and chooses for.

    Args:
        policy: ``"MABWiserPolicy"``.
        env: environment with `Discrete` actions, the arms, or its id.
        tie_breaking: ``"first"``, which is what the library does.
        kwargs: as in `BanditAlgorithm`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MABWiserPolicy": MABWiserPolicy}
    policy: MABWiserPolicy
    statistics: ClassVar[tuple[str, ...]] = SUMS

    def __init__(
        self,
        policy: str | type[BasePolicy] = "MABWiserPolicy",
        env: GymEnv | str | None = None,
        tie_breaking: TieBreaking = "first",
        **kwargs: Unpack[CommonArguments],
    ) -> None:
        super().__init__(policy, env, tie_breaking=tie_breaking, **kwargs)

    @abstractmethod
    def _learning_policy(self) -> Any:
        """The library's learning policy."""

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.tie_breaking != "first":
            raise ValueError("tie_breaking must be first: MABWiser takes the first of equal arms")
        self._check_observations()

    def _check_observations(self) -> None:
        check_space(self, "observations", self.observation_space)

    def _make_policy(self) -> MABWiserPolicy:
        policy: Any = self.policy_class
        made: MABWiserPolicy = policy(
            self.observation_space,
            self.action_space,
            learning_policy=self._learning_policy(),
            statistics=self.statistics,
        )
        return made

    def _contexts(self, obs: NDArray[Any]) -> Floats:
        return features(self.observation_space, obs)

    def _first_pull(self) -> int | None:
        """An arm to pull before the library is asked, which it cannot be without a reward."""
        return None if self.policy.fitted else 0

    def _choose(self, contexts: Floats, rng: np.random.Generator) -> tuple[Ints, Floats]:
        first = self._first_pull()
        arms = [self.policy.choose(c, rng) if first is None else first for c in contexts]
        return np.array(arms, dtype=np.int64), np.ones(len(arms))

    def _learn(self, pull: Pull) -> None:
        self.policy.learn(pull.arm, pull.reward, np.array(pull.context))


class MABWiserEpsilonGreedy(MABWiserAgent):
    """MABWiser's epsilon-greedy on sample averages, the same for all contexts.

    Args:
        policy: ``"MABWiserPolicy"``.
        env: as in `MABWiserAgent`.
        exploration_initial_eps: epsilon, which stays.
        kwargs: as in `MABWiserAgent`.
    """

    def __init__(
        self,
        policy: str | type[BasePolicy] = "MABWiserPolicy",
        env: GymEnv | str | None = None,
        exploration_initial_eps: float = 0.1,
        **kwargs: Unpack[LearningArguments],
    ) -> None:
        self.exploration_initial_eps = exploration_initial_eps
        super().__init__(policy, env, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_share(settings_of(self, "exploration_initial_eps"))

    def _learning_policy(self) -> Any:
        from mabwiser.mab import LearningPolicy

        return LearningPolicy.EpsilonGreedy(self.exploration_initial_eps)


class MABWiserUCB1(MABWiserAgent):
    """MABWiser's UCB1, the same for all contexts.

    Args:
        policy: ``"MABWiserPolicy"``.
        env: as in `MABWiserAgent`.
        c: how much to explore, the library's alpha.
        kwargs: as in `MABWiserAgent`.
    """

    statistics = (*SUMS, "arm_to_mean")

    def __init__(
        self,
        policy: str | type[BasePolicy] = "MABWiserPolicy",
        env: GymEnv | str | None = None,
        c: float = 1.0,
        **kwargs: Unpack[LearningArguments],
    ) -> None:
        self.c = c
        super().__init__(policy, env, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_at_least(0, settings_of(self, "c"))

    def _learning_policy(self) -> Any:
        from mabwiser.mab import LearningPolicy

        return LearningPolicy.UCB1(self.c)

    def _first_pull(self) -> int | None:
        """An arm not tried yet: the library would take its reward for 0 and leave it."""
        counts = self.policy.mab._imp.arm_to_count
        return next((arm for arm in self.policy.mab.arms if counts[arm] == 0), None)


class MABWiserThompson(MABWiserAgent):
    """MABWiser's Thompson sampling with Beta(1, 1) priors, the same for all contexts.

    Takes the arguments of `MABWiserAgent`.
    """

    statistics = ("arm_to_success_count", "arm_to_fail_count")

    @property
    def rewards_known(self) -> str:
        """Others would make its Beta distributions wrong without a word."""
        return reward_checks.BINARY

    def _learning_policy(self) -> Any:
        from mabwiser.mab import LearningPolicy

        return LearningPolicy.ThompsonSampling()


class MABWiserLinUCB(MABWiserAgent):
    """MABWiser's LinUCB; contexts that are numbers become one-hot.

    The ridge is 1: with another one, the library is wrong about arms not tried.

    Args:
        policy: ``"MABWiserPolicy"``.
        env: environment with `Box` observations of shape (d,) or `Discrete` ones, or its id.
        alpha: how many standard deviations the bound lies above the predicted reward.
        kwargs: as in `MABWiserAgent`.
    """

    def __init__(
        self,
        policy: str | type[BasePolicy] = "MABWiserPolicy",
        env: GymEnv | str | None = None,
        alpha: float = 1.0,
        **kwargs: Unpack[LearningArguments],
    ) -> None:
        self.alpha = alpha
        super().__init__(policy, env, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_at_least(0, settings_of(self, "alpha"))

    def _check_observations(self) -> None:
        space = self.observation_space
        if not (isinstance(space, spaces.Box) and len(space.shape) == 1):
            super()._check_observations()

    def _learning_policy(self) -> Any:
        from mabwiser.mab import LearningPolicy

        return LearningPolicy.LinUCB(self.alpha, l2_lambda=1.0)
