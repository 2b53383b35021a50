"""The base of the bandit agents that keep a score for each arm in each context."""

from __future__ import annotations

from typing import Any, ClassVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from rl_yardstick.agents.bandits.algorithm import ArmPolicy, Pull, RuleBandit
from rl_yardstick.agents.bandits.choosing import (
    PULL,
    Feedback,
    ScoreAgent,
    ScoreTables,
    allowed_room,
    choose_by_allowed_scores,
    count_and_learn,
    learn_one,
    nothing_before,
    row_of_scores,
)
from rl_yardstick.agents.common.settings import check_space
from rl_yardstick.agents.compiled.generators import handles_of
from rl_yardstick.agents.compiled.learning_algorithm import StepSize
from rl_yardstick.mdp.transition_model import Floats, Ints

# The policy of agents that keep a score for each arm: their knowledge, in buffers.


class BanditPolicy(ArmPolicy):
    """Pulls the arm of the highest score in the context.

    The tables are buffers, so that a model file's ``policy.pth`` contains them.
    """

    scores: th.Tensor  # of the arms, float64 of shape (C, A)
    sums: th.Tensor  # sum of the rewards, float64 of shape (C, A)
    counts: th.Tensor  # number of the rewards, int64 of shape (C, A)

    def __init__(
        self, *args: Any, n_contexts: int = 1, initial_score: float = 0.0, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        shape = (n_contexts, int(self.action_space.n))  # type: ignore[attr-defined]
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


# The base of agents that keep a score for each arm in each context.


class TableBandit(RuleBandit):
    """An agent with a score for each arm in each context; contexts are independent.

    Args:
        policy: ``"BanditPolicy"``.
        env: environment with `Discrete` observations, the contexts, or its id.
        learning_rate: step size, for agents that have one.
        ignore_context: use one row for all contexts, as a pooled A/B test does.
        kwargs: as in `BanditAlgorithm`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"BanditPolicy": BanditPolicy}
    policy: BanditPolicy
    parameters = {"ignore_context": np.bool_}  # noqa: RUF012
    initial_score: float = 0.0  # of every arm

    # Called by the training loops; each algorithm defines `choose_arm` and `learn_from_pull`.
    context_row = row_of_scores
    learn_from_reward = count_and_learn
    choose_allowed = choose_by_allowed_scores
    before_counting = nothing_before

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

    def _make_workspace(self, rng: np.random.Generator, n: int) -> ScoreAgent:
        return self.compiled_agent(rng)

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
