"""What agents share that explore by optimism: a table that begins at the most that can be."""

from __future__ import annotations

import math
from typing import Any, Unpack

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.common.setting_checks import check_finite, check_share, settings_of
from agents.common.signatures import TieBreaking
from agents.compiled.engine_choice import EngineChoice
from agents.tabular.mask_keeping import MaskedArguments
from agents.tabular.tabular_algorithm import TabularAlgorithm


class OptimisticAlgorithm(TabularAlgorithm):
    """Takes the best action at every step, and what it knows too little of for very good.

    Nothing is left to chance but ties, so that there is no exploration to set, and the step sizes
    follow from how often a pair was tried.

    Args:
        policy: ``"QTablePolicy"``.
        env: environment with `Discrete` observations and actions, or its id.
        gamma: discount factor.
        value_bound: the most that any state can be worth, at which the table begins. By default
            1 / (1 - gamma), which is right where no reward is above 1. Below what a state is worth
            it is optimism no more; far above it costs time.
        tie_breaking: as in `LearningAlgorithm`.
        engine: as in `TabularAlgorithm`.
        policy_kwargs: further arguments of the policy.
        kwargs: as in `MaskKeeper`.

    Raises:
        ValueError: if an argument lies outside its range, a space does not fit, or ``gamma`` is 1
            and there is no ``value_bound``.
    """

    parameters = {"highest_worth": np.float64}  # noqa: RUF012

    def __init__(
        self,
        policy: str | type[BasePolicy] = "QTablePolicy",
        env: GymEnv | str | None = None,
        gamma: float = 0.99,
        value_bound: float | None = None,
        tie_breaking: TieBreaking = "random",
        engine: EngineChoice = "auto",
        policy_kwargs: dict[str, Any] | None = None,
        **kwargs: Unpack[MaskedArguments],
    ) -> None:
        self.value_bound = value_bound
        super().__init__(
            policy,
            env,
            gamma=gamma,
            exploration_decay="constant",
            exploration_initial_eps=0.0,
            tie_breaking=tie_breaking,
            engine=engine,
            policy_kwargs=policy_kwargs,
            **kwargs,
        )

    def _check_arguments(self) -> None:
        check_share(settings_of(self, "gamma"))
        if self.value_bound is not None:
            check_finite(settings_of(self, "value_bound"))
        elif self.gamma == 1:
            raise ValueError("value_bound has to be given where gamma is 1")
        self.initial_q = self.highest_worth
        super()._check_arguments()

    @property
    def highest_worth(self) -> float:
        """What no state is worth more than."""
        if self.value_bound is None:
            return 1.0 / (1.0 - self.gamma) if self.gamma < 1 else math.inf
        return self.value_bound
