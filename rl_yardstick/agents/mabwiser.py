"""MABWiser's bandits with the interface of our own, for comparison (extra ``bandits``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self, Unpack

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from rl_yardstick.agents.bandits.algorithm import BINARY, BanditAlgorithm, Pull
from rl_yardstick.agents.bandits.linear import features
from rl_yardstick.agents.common.model_files import TablePolicy
from rl_yardstick.agents.common.settings import (
    CommonArguments,
    LearningArguments,
    TieBreaking,
    check_at_least,
    check_share,
    check_space,
    settings_of,
)
from rl_yardstick.mdp.transition_model import Floats, Ints

# MABWiser's bandits as policies.
#
# MABWiser 2.7.4 keeps its state in Python objects, and cannot predict before its first reward. Here
# the state is saved as one tensor, because a model file contains no pickle, and the caller passes
# the random number generator.


class MABWiserPolicy(TablePolicy):
    """Holds a `mabwiser.mab.MAB` over arms numbered from 0."""

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Discrete,
        lr_schedule: Schedule | None = None,
        learning_policy: Any = None,
        statistics: tuple[str, ...] = (),
        **kwargs: Any,
    ) -> None:
        from mabwiser.mab import MAB

        super().__init__(observation_space, action_space, **kwargs)
        self.statistics = statistics
        self.mab: Any = MAB(list(range(int(action_space.n))), learning_policy)
        self.fitted = False

    def _sizes(self) -> dict[str, Any]:
        chosen = self.mab.learning_policy
        name = [type(chosen).__name__, chosen._asdict()]
        return {"learning_policy": name, "statistics": self.statistics}

    @classmethod
    def _remade(cls, arguments: Mapping[str, Any]) -> Self:
        from mabwiser.mab import LearningPolicy

        name, settings = arguments["learning_policy"]
        if name not in KINDS:
            raise KeyError(name)
        chosen = getattr(LearningPolicy, name)(**settings)
        return cls(**{**arguments, "learning_policy": chosen})

    @property
    def is_contextual(self) -> bool:
        """Whether it uses the context."""
        return bool(self.mab.is_contextual)

    @property
    def parts(self) -> Floats:
        """The state: a row of numbers for each arm, shape (arms, ...)."""
        inside = self.mab._imp
        if self.is_contextual:
            models = [inside.arm_to_model[arm] for arm in self.mab.arms]
            rows = [[m.A.ravel(), m.A_inv.ravel(), m.Xty, m.beta] for m in models]
            return np.stack([np.concatenate(row) for row in rows])
        columns = [getattr(inside, name) for name in self.statistics]
        return np.array([[column[arm] for column in columns] for arm in self.mab.arms], dtype=float)

    def choose(self, context: Floats, rng: np.random.Generator) -> int:
        """The library's choice of an arm in ``context``, of shape (features,)."""
        self.mab._rng.rng = rng
        given = (context[None],) if self.is_contextual else ()
        return int(self.mab.predict(*given))

    def learn(self, arm: int, reward: float, context: Floats) -> None:
        """Let the library learn from one reward."""
        given = (context[None],) if self.is_contextual else ()
        learn = self.mab.partial_fit if self.fitted else self.mab.fit
        learn([arm], [reward], *given)
        self.fitted = True

    def judged(self, contexts: Floats) -> Floats:
        """The estimated mean reward of each arm, shape (n, arms)."""
        scores = np.zeros((len(contexts), len(self.mab.arms)))
        if not self.fitted:
            return scores
        if self.is_contextual:
            models = [self.mab._imp.arm_to_model[arm] for arm in self.mab.arms]
            return np.stack([contexts @ model.beta for model in models], axis=1)
        won, seen = self.parts[:, 0], self.parts[:, 1]
        if "arm_to_fail_count" in self.statistics:
            seen = won + seen
        scores[:] = np.divide(won, seen, out=np.full(len(won), -np.inf), where=seen > 0)
        return scores

    def _predict(
        self, observation: th.Tensor | dict[str, th.Tensor], deterministic: bool = False
    ) -> th.Tensor:
        """The first of the best arms, shape (n,), for observations of shape (n,) or (n, d)."""
        assert isinstance(observation, th.Tensor)
        contexts = features(self.observation_space, observation.numpy())
        return th.from_numpy(self.judged(contexts).argmax(axis=1))

    def get_extra_state(self) -> th.Tensor:
        """The state as a tensor, empty before the first reward."""
        return th.from_numpy(self.parts) if self.fitted else th.zeros(0, dtype=th.float64)

    def set_extra_state(self, state: th.Tensor) -> None:
        """Copy the state of another policy of this kind."""
        if len(state) == 0:
            return
        if len(state) != len(self.mab.arms):
            raise ValueError(f"holds {len(state)} arms, not {len(self.mab.arms)}")
        width = len(features(self.observation_space, self._any_observation())[0])
        self.learn(0, 0.0, np.zeros(width))
        inside, rows = self.mab._imp, state.numpy()
        if self.is_contextual:
            for arm, row in enumerate(rows):
                model = inside.arm_to_model[arm]
                a, a_inv, model.Xty, model.beta = np.split(
                    row.copy(), np.cumsum([width**2, width**2, width])
                )
                model.A, model.A_inv = a.reshape(width, width), a_inv.reshape(width, width)
            return
        for name, column in zip(self.statistics, rows.T.tolist(), strict=True):
            getattr(inside, name).update(enumerate(column))
        inside.total_count = sum(column[1] for column in rows.tolist())

    def _any_observation(self) -> NDArray[Any]:
        return np.zeros((1, *(self.observation_space.shape or ())))


SUMS = ("arm_to_sum", "arm_to_count", "arm_to_expectation")

# The library's learning policies that agents may use, also those in a model file.
KINDS = ("EpsilonGreedy", "LinUCB", "ThompsonSampling", "UCB1")


class MABWiserAgent(BanditAlgorithm):
    """The base of the agents that learn and choose by MABWiser.

    Args:
        policy: ``"MABWiserPolicy"``.
        env: environment with `Discrete` actions, the arms, or its id.
        tie_breaking: ``"first"``, as in the library.
        kwargs: as in `BanditAlgorithm`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MABWiserPolicy": MABWiserPolicy}
    policy: MABWiserPolicy
    kind: ClassVar[str]  # one of `KINDS`
    statistics: ClassVar[tuple[str, ...]] = SUMS

    def __init__(
        self,
        policy: str | type[BasePolicy] = "MABWiserPolicy",
        env: GymEnv | str | None = None,
        tie_breaking: TieBreaking = "first",
        **kwargs: Unpack[CommonArguments],
    ) -> None:
        super().__init__(policy, env, tie_breaking=tie_breaking, **kwargs)

    def _library_settings(self) -> dict[str, float]:
        """Arguments of the library's learning policy."""
        return {}

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.tie_breaking != "first":
            raise ValueError("tie_breaking must be first: MABWiser takes the first of equal arms")
        self._check_observations()

    def _check_observations(self) -> None:
        check_space(self, "observations", self.observation_space)

    def _make_policy(self) -> MABWiserPolicy:
        from mabwiser.mab import LearningPolicy

        policy: Any = self.policy_class
        made: MABWiserPolicy = policy(
            self.observation_space,
            self.action_space,
            learning_policy=getattr(LearningPolicy, self.kind)(**self._library_settings()),
            statistics=self.statistics,
        )
        return made

    def _contexts(self, obs: NDArray[Any]) -> Floats:
        return features(self.observation_space, obs)

    def _first_pull(self) -> int | None:
        """An arm to pull instead of the library's choice, which needs a reward first."""
        return None if self.policy.fitted else 0

    def _choose(  # type: ignore[override]  # the library knows no masks
        self, contexts: Floats, rng: np.random.Generator
    ) -> tuple[Ints, Floats]:
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
        exploration_initial_eps: epsilon, which is constant.
        kwargs: as in `MABWiserAgent`.
    """

    kind = "EpsilonGreedy"

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

    def _library_settings(self) -> dict[str, float]:
        return {"epsilon": self.exploration_initial_eps}


class MABWiserUCB1(MABWiserAgent):
    """MABWiser's UCB1, the same for all contexts.

    Args:
        policy: ``"MABWiserPolicy"``.
        env: as in `MABWiserAgent`.
        c: degree of exploration, the library's alpha.
        kwargs: as in `MABWiserAgent`.
    """

    kind = "UCB1"
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

    def _library_settings(self) -> dict[str, float]:
        return {"alpha": self.c}

    def _first_pull(self) -> int | None:
        """An untried arm: the library would take its mean reward for 0 and neglect it."""
        counts = self.policy.mab._imp.arm_to_count
        return next((arm for arm in self.policy.mab.arms if counts[arm] == 0), None)


class MABWiserThompson(MABWiserAgent):
    """MABWiser's Thompson sampling with Beta(1, 1) priors, the same for all contexts.

    Takes the arguments of `MABWiserAgent`.
    """

    kind = "ThompsonSampling"
    rewards_known = BINARY  # other rewards would silently make its Beta distributions wrong
    statistics = ("arm_to_success_count", "arm_to_fail_count")


class MABWiserLinUCB(MABWiserAgent):
    """MABWiser's LinUCB; contexts that are numbers become one-hot.

    The ridge is 1: with another one, the library is wrong about untried arms.

    Args:
        policy: ``"MABWiserPolicy"``.
        env: environment with `Box` observations of shape (d,) or `Discrete` ones, or its id.
        alpha: how many standard deviations the bound lies above the predicted reward.
        kwargs: as in `MABWiserAgent`.
    """

    kind = "LinUCB"

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

    def _library_settings(self) -> dict[str, float]:
        return {"alpha": self.alpha, "l2_lambda": 1.0}
