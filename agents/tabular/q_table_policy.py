"""The policy of the tabular agents: action values in tables."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from agents.common.table_policy import TablePolicy
from mdp.array_types import Floats


class QTablePolicy(TablePolicy):
    """Greedy in the mean of one or two tables of action values.

    The tables are float64 buffers, so that they travel in the ``policy.pth`` of a model file and
    need neither optimizer nor gradient.

    Args:
        observation_space: `Discrete` with S values.
        action_space: `Discrete` with A values.
        lr_schedule: not used; here because every policy is handed one.
        n_tables: number of tables T.

    Attributes:
        q_tables: action values, float64 of shape (T, S, A).
        visit_counts: number of updates of each entry, int64 of shape (T, S, A).
    """

    q_tables: th.Tensor
    visit_counts: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Discrete,
        action_space: spaces.Discrete,
        lr_schedule: Schedule | None = None,
        n_tables: int = 1,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, **kwargs)
        shape = (n_tables, int(observation_space.n), int(action_space.n))
        self.register_buffer("q_tables", th.zeros(shape, dtype=th.float64))
        self.register_buffer("visit_counts", th.zeros(shape, dtype=th.int64))

    def _sizes(self) -> dict[str, Any]:
        return {"n_tables": len(self.q_tables)}

    @property
    def q_table(self) -> Floats:
        """The action values that the agent acts on, shape (S, A)."""
        return np.asarray(self.q_tables.numpy().mean(axis=0))

    def _predict(
        self, observation: th.Tensor | dict[str, th.Tensor], deterministic: bool = False
    ) -> th.Tensor:
        """The first of the best actions; shapes (n,) to (n,)."""
        assert isinstance(observation, th.Tensor)
        values = self.q_tables[:, observation.long().flatten()].mean(dim=0)
        return th.from_numpy(values.numpy().argmax(axis=1))
