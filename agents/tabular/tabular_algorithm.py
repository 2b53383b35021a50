"""What all tabular agents share: their arguments, their tables, and how they act and learn."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Unpack

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule

from agents.common.exploration import STRATEGIES, action_probabilities
from agents.common.schedules import epsilon_schedule
from agents.common.setting_checks import (
    check_above_zero,
    check_epsilons,
    check_option,
    check_share,
    check_space,
    settings_of,
)
from agents.common.signatures import ExplorationDecay, TieBreaking
from agents.compiled.engine_choice import EngineChoice
from agents.compiled.learning_algorithm import StepSize
from agents.tabular.mask_keeping import MaskedArguments
from agents.tabular.q_table_policy import QTablePolicy
from agents.tabular.table_training import TableTraining
from mdp.array_types import Floats

ExplorationStrategy = Literal["epsilon_greedy", "boltzmann", "gaussian_noise"]


class TabularAlgorithm(TableTraining):
    """Temporal-difference control on a table of action values.

    Args:
        policy: ``"QTablePolicy"``.
        env: environment with `Discrete` observations and actions, or its id.
        learning_rate: step size, constant or scheduled, or ``"sample_average"`` for 1/N(s, a).
        gamma: discount factor.
        exploration: ``"epsilon_greedy"``; ``"boltzmann"`` (softmax of value / temperature); or
            ``"gaussian_noise"`` (greedy in value + noise_std / (episode + 1) * normal noise, the
            episodes counted over all environments).
        exploration_fraction: share of training over which epsilon falls.
        exploration_initial_eps: epsilon at the start.
        exploration_final_eps: epsilon at the end of that share.
        exploration_decay: how epsilon falls; ``"constant"`` stays at the initial value.
        temperature: of ``"boltzmann"``, above 0, constant or scheduled.
        noise_std: of ``"gaussian_noise"``, constant or scheduled.
        tie_breaking: as in `LearningAlgorithm`.
        initial_q: value of every entry of the table at the start; high values are optimistic.
        initial_q_std: standard deviation of normal noise on the entries at the start.
        skip_terminal_update: learn nothing from the step that terminates an episode, a common
            omission in hand-written programs, here to reproduce their results.
        engine: ``"compiled"`` trains on a compiled copy of the environments, to the same bits and
            a hundred times faster, and is refused where there is none; ``"interpreted"`` calls
            them step by step; ``"auto"`` compiles where it can.
        policy_kwargs: further arguments of the policy.
        kwargs: as in `MaskKeeper`, ``mask_actions`` among them.

    Raises:
        ValueError: if an argument lies outside its range or a space does not fit.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"QTablePolicy": QTablePolicy}
    parameters = {"gamma": np.float64, "skip_terminal_update": np.bool_}  # noqa: RUF012
    logs_by_records = True

    def __init__(
        self,
        policy: str | type[BasePolicy] = "QTablePolicy",
        env: GymEnv | str | None = None,
        learning_rate: StepSize = 0.1,
        gamma: float = 0.99,
        exploration: ExplorationStrategy = "epsilon_greedy",
        exploration_fraction: float = 0.5,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
        exploration_decay: ExplorationDecay = "linear",
        temperature: float | Schedule = 1.0,
        noise_std: float | Schedule = 1.0,
        tie_breaking: TieBreaking = "random",
        initial_q: float = 0.0,
        initial_q_std: float = 0.0,
        skip_terminal_update: bool = False,
        engine: EngineChoice = "auto",
        policy_kwargs: dict[str, Any] | None = None,
        **kwargs: Unpack[MaskedArguments],
    ) -> None:
        self.gamma = gamma
        self.exploration = exploration
        self.exploration_fraction = exploration_fraction
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_decay = exploration_decay
        self.temperature = temperature
        self.noise_std = noise_std
        self.initial_q = initial_q
        self.initial_q_std = initial_q_std
        self.skip_terminal_update = skip_terminal_update
        self.engine = engine
        super().__init__(policy, env, learning_rate, tie_breaking, policy_kwargs, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_space(self, "observations", self.observation_space)
        check_space(self, "actions", self.action_space)
        check_option("exploration", self.exploration, ExplorationStrategy)
        check_option("engine", self.engine, EngineChoice)
        check_epsilons(self)
        check_share(settings_of(self, "gamma"))
        check_above_zero(settings_of(self, "temperature"))

    def _make_policy(self) -> QTablePolicy:
        policy = super()._make_policy()
        noise = self.rng.standard_normal(policy.q_tables.shape)
        with np.errstate(over="ignore"):
            tables = self.initial_q + self.initial_q_std * noise
        if not np.isfinite(tables).all():
            given = f"{self.initial_q:g} and {self.initial_q_std:g}"
            raise ValueError(f"initial_q and initial_q_std must give finite values, not {given}")
        policy.q_tables.copy_(th.from_numpy(tables))
        return policy

    def _make_exploration_schedule(self) -> Schedule:
        if self.exploration == "boltzmann":
            return FloatSchedule(self.temperature)
        if self.exploration == "gaussian_noise":
            return FloatSchedule(self.noise_std)
        return epsilon_schedule(
            self.exploration_decay,
            self.exploration_initial_eps,
            self.exploration_final_eps,
            self.exploration_fraction,
        )

    @property
    def strategy(self) -> int:
        """How the agent explores around its values, one of `agents.common.exploration`."""
        return STRATEGIES[self.exploration]

    @property
    def exploration_rate(self) -> float:
        """How much the agent explores now: epsilon, temperature or standard deviation."""
        rate = super().exploration_rate
        if self.exploration == "gaussian_noise":
            return rate / (self._episode_num + 1)
        return rate

    def action_probabilities(self) -> Floats:
        """What the exploring policy does now, shape (S, A).

        Raises:
            ValueError: for Gaussian noise, whose probabilities have no closed form.
        """
        return action_probabilities(
            self.strategy,
            self.policy.q_table,
            self.exploration_rate,
            random_ties=self.tie_breaking == "random",
            masks=self.policy.masks,
        )

    def _record_training(self) -> None:
        self.logger.record("rollout/exploration_rate", self.exploration_rate)
        self.logger.record("train/mean_absolute_td_error", self.mean_td_error)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if not self.averages_samples:
            rate = self.lr_schedule(self._current_progress_remaining)
            self.logger.record("train/learning_rate", rate)

    def log_columns(self, records: NDArray[np.void]) -> dict[str, list[float]]:
        """As above; Gaussian noise falls with the episodes."""
        columns = super().log_columns(records)
        if self.exploration == "gaussian_noise":
            rates = records["exploration"] / (records["episodes"] + 1)
            columns["rollout/exploration_rate"] = rates.tolist()
        return columns
