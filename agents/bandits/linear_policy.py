"""The policy of agents with a linear model of each arm's reward: all that they know, in buffers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import Schedule

from agents.bandits.arm_policy import ArmPolicy
from agents.bandits.linear_agent import Regressions
from mdp.array_types import Floats


class LinearBanditPolicy(ArmPolicy):
    """Pulls the arm of the highest predicted reward.

    Args:
        observation_space: `Box` of shape (d,), or `Discrete` with d values, each of them a feature.
        action_space: `Discrete` with A values: the arms.
        lr_schedule: not used; here because every policy is handed one.
        ridge: what the regressions start from, on the diagonal.

    Attributes:
        factors: of each arm's regression matrix, float64 of shape (A, d, d).
        moments: sum of reward times context, float64 of shape (A, d).
        coefficients: of each arm's regression, float64 of shape (A, d).
        counts: number of rewards of each arm, int64 of shape (A,).
    """

    factors: th.Tensor
    moments: th.Tensor
    coefficients: th.Tensor
    counts: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Discrete,
        lr_schedule: Schedule | None = None,
        ridge: float = 1.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, **kwargs)
        n_arms, n_features = int(action_space.n), number_of_features(observation_space)
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
    """Length of the vectors that `features` makes."""
    return int(space.n) if isinstance(space, spaces.Discrete) else int(space.shape[0])  # type: ignore[index]


def features(space: spaces.Space[Any], observations: NDArray[Any]) -> Floats:
    """Observations as vectors, one-hot where they are numbers; shape (n, d)."""
    n_features = number_of_features(space)
    if isinstance(space, spaces.Discrete):
        return np.asarray(np.eye(n_features)[observations.astype(np.int64).reshape(-1)])
    vectors: Floats = observations.astype(np.float64).reshape(-1, n_features)
    return vectors
