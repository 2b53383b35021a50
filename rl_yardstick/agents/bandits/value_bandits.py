"""Epsilon-greedy and softmax around estimates of the arms' mean rewards."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule

from rl_yardstick.agents.bandits.algorithm import EpsilonGreedyBandit
from rl_yardstick.agents.bandits.choosing import ScoreAgent
from rl_yardstick.agents.bandits.tables import TableBandit
from rl_yardstick.agents.common.exploration import (
    BOLTZMANN,
    action_probabilities,
    choose_action,
)
from rl_yardstick.agents.common.settings import POSITIVE, step_size
from rl_yardstick.agents.compiled.generators import generator_of
from rl_yardstick.agents.compiled.learning_algorithm import StepSize
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Floats


@inlined
def choose_by_value(agent: ScoreAgent, row: int, progress: Any) -> int:
    """Explore around the values, as the tabular agents do."""
    rng, strategy = generator_of(agent.rng), agent.settings.strategy
    agent.draws[0] = rng.random()
    if strategy != BOLTZMANN:
        agent.draws[1] = rng.random()
    for arm in range(len(agent.arms)):
        agent.arms[arm] = agent.tables.scores[row, arm]
    tie_scale = agent.settings.tie_scale
    return choose_action(strategy, agent.arms, progress.exploration, tie_scale, agent.draws)


@inlined
def move_value(agent: ScoreAgent, pull: Any, progress: Any) -> None:
    """Move the arm's value towards the reward."""
    count = agent.tables.counts[pull.row, pull.arm]
    size = step_size(progress.learning_rate, agent.settings.averages_samples, count)
    error = pull.reward - agent.tables.scores[pull.row, pull.arm]
    agent.tables.scores[pull.row, pull.arm] += size * error


class ValueBandit(TableBandit):
    """Explores around estimates of the arms' mean rewards, as the tabular agents do.

    Args:
        args: as in `TableBandit`.
        learning_rate: step size, constant or scheduled, or ``"sample_average"`` for 1/N.
        initial_q: estimate of every arm at the start; high values are optimistic.
        kwargs: as in `TableBandit`.
    """

    choose_arm = choose_by_value
    learn_from_pull = move_value

    def __init__(
        self,
        *args: Any,
        learning_rate: StepSize = "sample_average",
        initial_q: float = 0.0,
        **kwargs: Any,
    ) -> None:
        self.initial_q = initial_q
        super().__init__(*args, learning_rate=learning_rate, **kwargs)

    @property
    def initial_score(self) -> float:  # type: ignore[override]
        """The estimate of every arm at the start."""
        return self.initial_q

    def action_probabilities(self, observations: NDArray[Any]) -> Floats:
        """The exploring policy's present probabilities at each of n observations, (n, arms)."""
        values, ties = self.policy.judged(observations), self.tie_breaking == "random"
        rate = self.exploration_rate
        return action_probabilities(self.strategy, values, rate, random_ties=ties)


class EpsilonGreedy(EpsilonGreedyBandit, ValueBandit):
    """Epsilon-greedy (Sutton and Barto, sections 2.2 to 2.6).

    Takes the arguments of `EpsilonGreedyBandit` and `ValueBandit`.
    """


class Boltzmann(ValueBandit):
    """Softmax of value / temperature.

    Args:
        args: as in `ValueBandit`.
        temperature: above 0, constant or scheduled.
        kwargs: as in `ValueBandit`.
    """

    strategy = BOLTZMANN
    ranges = {"temperature": POSITIVE}  # noqa: RUF012

    def __init__(self, *args: Any, temperature: float | Schedule = 0.1, **kwargs: Any) -> None:
        self.temperature = temperature
        super().__init__(*args, **kwargs)

    def _make_exploration_schedule(self) -> Schedule:
        return FloatSchedule(self.temperature)
