"""Bandit agents with a score for each arm in each context: the base, epsilon-greedy, softmax."""

from __future__ import annotations

from typing import Any, ClassVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule

from rl_yardstick.agents.bandits.algorithm import ArmPolicy, EpsilonGreedyBandit, Pull, RuleBandit
from rl_yardstick.agents.bandits.choosing import (
    PULL,
    Feedback,
    ScoreAgent,
    ScoreTables,
    allowed_room,
    choose_by_allowed_scores,
    count_reward,
    learn_one,
    row_of_scores,
)
from rl_yardstick.agents.common.exploration import BOLTZMANN, action_probabilities, choose_action
from rl_yardstick.agents.common.settings import POSITIVE, check_space, step_size
from rl_yardstick.agents.compiled.learning_algorithm import StepSize
from rl_yardstick.agents.compiled.references import generator_of, handles_of
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Floats, Ints


class BanditPolicy(ArmPolicy):
    """Pulls the arm of the highest score in the context.

    The tables are buffers, so that a model file's ``policy.pth`` contains them.
    """

    scores: th.Tensor  # of the arms, float64 of shape (C, A)
    sums: th.Tensor  # sum of the rewards, float64 of shape (C, A)
    counts: th.Tensor  # number of the rewards, int64 of shape (C, A)
    sizes = ("n_contexts",)

    def __init__(
        self, *args: Any, n_contexts: int = 1, initial_score: float = 0.0, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.n_contexts = n_contexts
        shape = (n_contexts, int(self.action_space.n))  # type: ignore[attr-defined]
        self.register_buffer("scores", th.full(shape, initial_score, dtype=th.float64))
        self.register_buffer("sums", th.zeros(shape, dtype=th.float64))
        self.register_buffer("counts", th.zeros(shape, dtype=th.int64))

    @property
    def tables(self) -> ScoreTables:
        """The buffers as arrays that share their memory."""
        return ScoreTables(self.scores.numpy(), self.sums.numpy(), self.counts.numpy())

    def judged(self, observations: NDArray[Any]) -> Floats:
        rows = observations.astype(np.int64).reshape(-1)
        scores: Floats = self.scores.numpy()[rows % len(self.scores)]
        return scores


class TableBandit(RuleBandit):
    """An agent with a score for each arm in each context; contexts are independent.

    Args:
        policy: ``"BanditPolicy"``.
        env: environment with `Discrete` observations, the contexts, or its id.
        learning_rate: step size, for agents that have one.
        ignore_context: use one row for all contexts, as a pooled A/B test does.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"BanditPolicy": BanditPolicy}
    policy: BanditPolicy
    parameters = {"ignore_context": np.bool_}  # noqa: RUF012
    initial_score: float = 0.0  # of every arm

    # Called by the training loops; an algorithm adds `choose_arm` and `learn_from_reward`.
    context_row = row_of_scores
    choose_allowed = choose_by_allowed_scores

    def __init__(
        self,
        policy: str | type[BasePolicy] = "BanditPolicy",
        env: GymEnv | str | None = None,
        *,
        learning_rate: StepSize = 0.0,
        ignore_context: bool = False,
        **kwargs: Any,
    ) -> None:
        self.ignore_context = ignore_context
        super().__init__(policy, env, learning_rate, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_space(self, "observations", self.observation_space)

    def _policy_arguments(self) -> dict[str, Any]:
        n_observations = int(cast(spaces.Discrete, self.observation_space).n)
        n_contexts = 1 if self.ignore_context else n_observations
        return {"n_contexts": n_contexts, "initial_score": self.initial_score}

    def compiled_agent(
        self, rng: np.random.Generator, tables: ScoreTables | None = None, capacity: int = 1
    ) -> ScoreAgent:
        """The agent for compiled functions."""
        return ScoreAgent(
            self.settings()[0],
            tables or self.policy.tables,
            Feedback(np.zeros(capacity, dtype=PULL), np.zeros(1, dtype=np.int64)),
            np.empty(self.n_arms),
            np.empty(2),
            handles_of([rng])[0],
        )

    def _contexts(self, obs: NDArray[Any]) -> Ints:
        rows = obs.astype(np.int64).reshape(-1)
        return np.zeros_like(rows) if self.ignore_context else rows

    def _rows(self, agent: ScoreAgent, contexts: Ints) -> tuple[Ints, int]:
        return contexts, len(agent.tables.scores)

    def _learn(self, pull: Pull) -> None:
        agent, progress = self._workspace_for(self.rng, 1), self.progress()[0]
        record = np.array([pull[:4]], dtype=PULL)[0]
        mask = np.ones(self.n_arms, np.bool_) if pull.mask is None else np.array(pull.mask)
        learn_one(agent, record, mask, allowed_room(self.n_arms), progress)

    def estimates(self, tables: ScoreTables) -> Floats:
        """The agent's estimates of the arms' mean rewards, shapes (..., contexts, arms)."""
        return tables.scores


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
    count_reward(agent.tables, pull)
    count = agent.tables.counts[pull.row, pull.arm]
    size = step_size(progress.learning_rate, agent.settings.averages_samples, count)
    error = pull.reward - agent.tables.scores[pull.row, pull.arm]
    agent.tables.scores[pull.row, pull.arm] += size * error


class ValueBandit(TableBandit):
    """Explores around estimates of the arms' mean rewards, as the tabular agents do.

    Args:
        learning_rate: step size, constant or scheduled, or ``"sample_average"`` for 1/N.
        initial_q: estimate of every arm at the start; high values are optimistic.
    """

    choose_arm = choose_by_value
    learn_from_reward = move_value

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
        temperature: above 0, constant or scheduled.
    """

    strategy = BOLTZMANN
    ranges = {"temperature": POSITIVE}  # noqa: RUF012

    def __init__(self, *args: Any, temperature: float | Schedule = 0.1, **kwargs: Any) -> None:
        self.temperature = temperature
        super().__init__(*args, **kwargs)

    def _make_exploration_schedule(self) -> Schedule:
        return FloatSchedule(self.temperature)
