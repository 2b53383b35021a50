"""What tabular agents share that learn a model of their environment."""

from __future__ import annotations

from typing import Any, ClassVar

from stable_baselines3.common.policies import BasePolicy

from agents.tabular.models.model_policy import ModelPolicy
from agents.tabular.q_table_policy import QTablePolicy
from agents.tabular.tabular_algorithm import TabularAlgorithm

MOST_PLANNING = 10**6  # updates after one step


class ModelKeeper(TabularAlgorithm):
    """Hands the model in its policy to compiled functions as ``agent.memory``.

    Attributes:
        outcomes_kept: how many outcomes of each pair of state and action the model holds.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"QTablePolicy": ModelPolicy}
    policy: ModelPolicy
    outcomes_kept: int = 1

    def _make_policy(self) -> QTablePolicy:
        policy = super()._make_policy()
        assert isinstance(policy, ModelPolicy)
        policy.keep_outcomes(self.outcomes_kept)
        return policy

    def _memory_in_use(self) -> Any:
        return self.policy.model

    def _check_tables(self) -> None:
        super()._check_tables()
        self.policy.check_shapes()
