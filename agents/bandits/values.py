"""Epsilon-greedy and softmax around estimates of the arms' mean rewards."""

from __future__ import annotations

from typing import Literal, Unpack

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule

from agents.bandits.arguments import (
    ExplorationDecay,
    TableArguments,
    check_above_zero,
    check_epsilons,
    check_learning_rate,
)
from agents.bandits.table_bandit import TableBandit
from agents.bandits.tables import VALUES, Settings
from agents.common.exploration import STRATEGIES
from agents.common.schedules import epsilon_schedule

StepSize = float | Schedule | Literal["sample_average"]


class ValueBandit(TableBandit):
    """Explores around estimates of the arms' mean rewards, as the tabular agents do."""

    rule = VALUES
    strategy: int
    initial_q: float

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_learning_rate(self.learning_rate)

    @property
    def initial_score(self) -> float:
        """The estimate of every arm at the start."""
        return self.initial_q

    @property
    def settings(self) -> Settings:
        """With the strategy and the step size."""
        return super().settings._replace(
            strategy=self.strategy, sample_average=self.averages_samples
        )


class EpsilonGreedy(ValueBandit):
    """Epsilon-greedy (Sutton and Barto, sections 2.2 to 2.6).

    Args:
        policy: ``"BanditPolicy"``.
        env: as in `TableBandit`.
        learning_rate: step size, constant or scheduled, or ``"sample_average"`` for 1/N.
        initial_q: estimate of every arm at the start; high values are optimistic.
        exploration_initial_eps: epsilon at the start.
        exploration_final_eps: epsilon at the end of ``exploration_fraction``.
        exploration_fraction: share of training over which epsilon falls.
        exploration_decay: how epsilon falls; ``"constant"`` stays at the initial value.
        kwargs: as in `TableBandit`.
    """

    strategy = STRATEGIES["epsilon_greedy"]

    def __init__(
        self,
        policy: str | type[BasePolicy] = "BanditPolicy",
        env: GymEnv | str | None = None,
        learning_rate: StepSize = "sample_average",
        initial_q: float = 0.0,
        exploration_initial_eps: float = 0.1,
        exploration_final_eps: float = 0.01,
        exploration_fraction: float = 1.0,
        exploration_decay: ExplorationDecay = "constant",
        **kwargs: Unpack[TableArguments],
    ) -> None:
        self.initial_q = initial_q
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_fraction = exploration_fraction
        self.exploration_decay = exploration_decay
        self._step_size = learning_rate
        super().__init__(policy, env, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_epsilons(self)

    def _make_exploration_schedule(self) -> Schedule:
        return epsilon_schedule(
            self.exploration_decay,
            self.exploration_initial_eps,
            self.exploration_final_eps,
            self.exploration_fraction,
        )


class Boltzmann(ValueBandit):
    """Softmax of value / temperature.

    Args:
        policy: ``"BanditPolicy"``.
        env: as in `TableBandit`.
        learning_rate: step size, constant or scheduled, or ``"sample_average"`` for 1/N.
        initial_q: estimate of every arm at the start.
        temperature: above 0, constant or scheduled.
        kwargs: as in `TableBandit`.
    """

    strategy = STRATEGIES["boltzmann"]

    def __init__(
        self,
        policy: str | type[BasePolicy] = "BanditPolicy",
        env: GymEnv | str | None = None,
        learning_rate: StepSize = "sample_average",
        initial_q: float = 0.0,
        temperature: float | Schedule = 0.1,
        **kwargs: Unpack[TableArguments],
    ) -> None:
        self.initial_q = initial_q
        self.temperature = temperature
        self._step_size = learning_rate
        super().__init__(policy, env, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_above_zero([("temperature", self.temperature)])

    def _make_exploration_schedule(self) -> Schedule:
        return FloatSchedule(self.temperature)
