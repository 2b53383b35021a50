"""Contextual agents with a linear model of each arm: LinUCB and similar ones."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from rl_yardstick.agents.bandits.algorithm import ArmPolicy, EpsilonGreedyBandit, Pull, RuleBandit
from rl_yardstick.agents.bandits.choosing import (
    PULL,
    Feedback,
    LinearAgent,
    Regressions,
    choose_by_allowed_models,
    choose_by_model,
    deviation,
    learn_by_model,
    learn_one_by_model,
    row_of_vector,
)
from rl_yardstick.agents.common.exploration import choose_action
from rl_yardstick.agents.common.settings import NOT_NEGATIVE, POSITIVE, check_vectors
from rl_yardstick.agents.compiled.references import generator_of, handles_of
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Floats, Ints


class LinearBanditPolicy(ArmPolicy):
    """Pulls the arm of the highest predicted reward."""

    factors: th.Tensor  # of each arm's regression matrix, float64 of shape (A, d, d)
    moments: th.Tensor  # sum of reward times context, float64 of shape (A, d)
    coefficients: th.Tensor  # of each arm's regression, float64 of shape (A, d)
    counts: th.Tensor  # number of rewards of each arm, int64 of shape (A,)
    sizes = ("ridge",)

    def __init__(self, *args: Any, ridge: float = 1.0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.ridge = ridge
        n_arms = int(self.action_space.n)  # type: ignore[attr-defined]
        n_features = number_of_features(self.observation_space)
        identity = ridge * th.eye(n_features, dtype=th.float64)
        self.register_buffer("factors", identity.repeat(n_arms, 1, 1))
        self.register_buffer("moments", th.zeros((n_arms, n_features), dtype=th.float64))
        self.register_buffer("coefficients", th.zeros((n_arms, n_features), dtype=th.float64))
        self.register_buffer("counts", th.zeros(n_arms, dtype=th.int64))

    @property
    def models(self) -> Regressions:
        """The buffers as arrays that share their memory."""
        return Regressions(
            self.factors.numpy(),
            self.moments.numpy(),
            self.coefficients.numpy(),
            self.counts.numpy(),
        )

    def judged(self, observations: NDArray[Any]) -> Floats:
        contexts = features(self.observation_space, observations)
        return np.asarray(contexts @ self.coefficients.numpy().T)


def number_of_features(space: spaces.Space[Any]) -> int:
    """Length of the vectors that `features` returns."""
    return int(space.n) if isinstance(space, spaces.Discrete) else int(space.shape[0])  # type: ignore[index]


def features(space: spaces.Space[Any], observations: NDArray[Any]) -> Floats:
    """Observations as vectors, one-hot where they are numbers; shape (n, d)."""
    n_features = number_of_features(space)
    if isinstance(space, spaces.Discrete):
        return np.asarray(np.eye(n_features)[observations.astype(np.int64).reshape(-1)])
    vectors: Floats = observations.astype(np.float64).reshape(-1, n_features)
    return vectors


@inlined
def confidence_bonus(agent: LinearAgent, arm: int, context: Floats) -> float:
    """``alpha`` standard deviations of the prediction."""
    return float(agent.settings.alpha * deviation(agent, arm, context))


@inlined
def sampled_bonus(agent: LinearAgent, arm: int, context: Floats) -> float:
    """A draw from the posterior of the prediction, less its mean.

    For a single context, one normal number per arm has the same distribution as a prediction from
    a draw of all its coefficients.
    """
    noise = agent.settings.alpha * generator_of(agent.rng).standard_normal()
    return float(noise * deviation(agent, arm, context))


@inlined
def pick_epsilon_greedily(agent: LinearAgent, progress: Any) -> int:
    """A uniformly random arm with probability epsilon, else a best one."""
    settings = agent.settings
    agent.draws[1] = generator_of(agent.rng).random()
    epsilon, ties = progress.exploration, settings.tie_scale
    return choose_action(settings.strategy, agent.arms, epsilon, ties, agent.draws)


class LinearBanditAgent(RuleBandit):
    """An agent with a ridge regression for each arm; contexts that are numbers become one-hot.

    Args:
        policy: ``"LinearBanditPolicy"``.
        env: environment with `Box` observations of shape (d,) or `Discrete` ones, or its id.
        ridge: regularisation: the diagonal of each regression matrix at the start, above 0.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "LinearBanditPolicy": LinearBanditPolicy
    }
    policy: LinearBanditPolicy

    # Called by the training loops; each algorithm defines `bonus`.
    choose_arm = choose_by_model
    context_row = row_of_vector
    learn_from_reward = learn_by_model
    choose_allowed = choose_by_allowed_models
    hidden_arguments: ClassVar[tuple[str, ...]] = ("learning_rate",)
    ranges = {"ridge": POSITIVE}  # noqa: RUF012

    def __init__(
        self,
        policy: str | type[BasePolicy] = "LinearBanditPolicy",
        env: GymEnv | str | None = None,
        ridge: float = 1.0,
        **kwargs: Any,
    ) -> None:
        self.ridge = ridge
        super().__init__(policy, env, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_vectors(self, self.observation_space)

    def compiled_agent(
        self,
        rng: np.random.Generator,
        models: Regressions | None = None,
        capacity: int = 1,
        context: Floats | None = None,
    ) -> LinearAgent:
        """The agent for compiled functions."""
        n_features = number_of_features(self.observation_space)
        return LinearAgent(
            self.settings()[0],
            models or self.policy.models,
            Feedback(np.zeros(capacity, dtype=PULL), np.zeros(1, dtype=np.int64)),
            np.empty((capacity, n_features)),
            np.empty(n_features) if context is None else context,
            np.arange(self.n_arms),
            np.empty(self.n_arms),
            np.empty(n_features),
            np.empty(2),
            handles_of([rng])[0],
        )

    def _contexts(self, obs: NDArray[Any]) -> Floats:
        return features(self.observation_space, obs)

    def _rows(self, agent: LinearAgent, contexts: Floats) -> tuple[Ints, int]:
        agent.contexts[:] = contexts
        return np.arange(len(contexts)), len(contexts)

    def _learn(self, pull: Pull) -> None:
        agent = self._workspace_for(self.rng, 1)
        agent.contexts[0] = pull.context
        learn_one_by_model(agent, np.array([(0, *pull[1:4])], dtype=PULL)[0])


class LinUCB(LinearBanditAgent):
    """Linear upper confidence bounds with disjoint models (Li et al., 2010).

    Args:
        alpha: how many standard deviations the bound lies above the predicted reward.
    """

    parameters = {"alpha": np.float64}  # noqa: RUF012
    ranges = {"alpha": NOT_NEGATIVE}  # noqa: RUF012
    bonus = confidence_bonus

    def __init__(self, *args: Any, alpha: float = 1.0, **kwargs: Any) -> None:
        self.alpha = alpha
        super().__init__(*args, **kwargs)


class LinThompson(LinUCB):
    """Linear Thompson sampling (Agrawal and Goyal, 2013), with a model for each arm.

    Args:
        alpha: factor of the posterior's standard deviation; correct is the noise's of the rewards.
    """

    bonus = sampled_bonus


class LinEpsilonGreedy(EpsilonGreedyBandit, LinearBanditAgent):
    """Epsilon-greedy in the predicted rewards.

    Takes the arguments of `EpsilonGreedyBandit` and `LinearBanditAgent`.
    """

    pick = pick_epsilon_greedily
