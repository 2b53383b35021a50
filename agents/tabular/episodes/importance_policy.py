"""The policy of off-policy Monte Carlo control: action values, and the weights behind them."""

from __future__ import annotations

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from agents.tabular.q_table_policy import QTablePolicy


class ImportanceTablePolicy(QTablePolicy):
    """Greedy in a table of action values, each the weighted mean of returns.

    Args:
        observation_space: as in `QTablePolicy`.
        action_space: as in `QTablePolicy`.
        lr_schedule: as in `QTablePolicy`.
        kwargs: as in `QTablePolicy`.

    Attributes:
        weights: sum of the weights of the returns of each entry, float64 of shape (T, S, A).
    """

    weights: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Discrete,
        action_space: spaces.Discrete,
        lr_schedule: Schedule | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, lr_schedule, **kwargs)
        self.register_buffer("weights", th.zeros_like(self.q_tables))
