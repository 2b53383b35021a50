"""The policy of agents that keep a score for each arm: all that they know, in buffers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import Schedule

from agents.bandits.arm_policy import ArmPolicy
from agents.bandits.score_agent import ScoreTables
from mdp.array_types import Floats, Ints


class BanditPolicy(ArmPolicy):
    """Pulls the arm of the highest score in the context.

    The tables are buffers, so that they travel in the ``policy.pth`` of a model file.

    Args:
        observation_space: `Discrete`: the context.
        action_space: `Discrete` with A values: the arms.
        lr_schedule: not used; here because every policy is handed one.
        n_contexts: number of contexts C that are told apart; 1 for none.
        initial_score: of every arm at the start.

    Attributes:
        scores: what the agent judges arms by, float64 of shape (C, A).
        sums: sum of the rewards, float64 of shape (C, A).
        counts: number of the rewards, int64 of shape (C, A).
    """

    scores: th.Tensor
    sums: th.Tensor
    counts: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Discrete,
        action_space: spaces.Discrete,
        lr_schedule: Schedule | None = None,
        n_contexts: int = 1,
        initial_score: float = 0.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, **kwargs)
        shape = (n_contexts, int(action_space.n))
        self.register_buffer("scores", th.full(shape, initial_score, dtype=th.float64))
        self.register_buffer("sums", th.zeros(shape, dtype=th.float64))
        self.register_buffer("counts", th.zeros(shape, dtype=th.int64))

    def _sizes(self) -> dict[str, Any]:
        return {"n_contexts": len(self.scores)}

    @property
    def tables(self) -> ScoreTables:
        """The buffers as arrays that share their memory."""
        return ScoreTables(self.scores.numpy(), self.sums.numpy(), self.counts.numpy())

    @property
    def mean_rewards(self) -> Floats:
        """Average reward of each arm, nan where there is none, shape (C, A)."""
        return mean_rewards(self.sums.numpy(), self.counts.numpy())

    def judged(self, observations: NDArray[Any]) -> Floats:
        rows = observations.astype(np.int64).reshape(-1)
        scores: Floats = self.scores.numpy()[rows % len(self.scores)]
        return scores


def mean_rewards(sums: Floats, counts: Ints) -> Floats:
    """Sums over counts, nan where the count is 0; all of one shape."""
    means = np.full(sums.shape, np.nan)
    np.divide(sums, counts, out=means, where=counts > 0)
    return means
