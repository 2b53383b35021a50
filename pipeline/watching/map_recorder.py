"""Keeps what an agent does in every state as it learns, and what its logger says beside it.

Of more maps than a page has room for, every second one is kept, then every fourth, and so on.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from agents.common.callback_horizons import BlockCallback
from pipeline.evaluation.exact import ExactEvaluator
from pipeline.evaluation.value_maps import MAX_STATES, best_actions_of
from pipeline.finite_numbers import NotFiniteError, check_model
from pipeline.watching.growing_rows import GrowingRows

MOST_MAPS = 1000
MOST_FIGURES = 200_000  # of all maps together
FEWEST_MAPS = 2  # the first and the last

# What the library's agents log of a training, by the names that it has here.
LOGGED = {
    "loss": "train/loss",
    "policy_loss": "train/policy_loss",
    "value_loss": "train/value_loss",
    "entropy_loss": "train/entropy_loss",
}


class MapRecorder(BaseCallback):
    """Keeps the greedy policy and what each state is worth under it, at many moments.

    Args:
        evaluator: of the environment that the agent is judged on.

    Attributes:
        unit: what a map is kept after.
        moments: records of the type that `moment_type` makes.
        stride: of how many units one is kept.
        n_units: how many there were.
    """

    unit: ClassVar[str]

    def __init__(self, evaluator: ExactEvaluator) -> None:
        super().__init__()
        n_states = evaluator.model.n_states
        self.evaluator = evaluator
        self.moments = GrowingRows(moment_type(n_states))
        self.most = min(max(MOST_FIGURES // (2 * n_states), FEWEST_MAPS), MOST_MAPS)
        self.stride = 1
        self.n_units = 0

    @property
    def has_begun(self) -> bool:
        """Whether there is anything to show."""
        return len(self.moments) > 0

    def _on_training_start(self) -> None:
        if not self.has_begun:
            self._append()

    def finish(self) -> None:
        """Keep what the agent does at the end, unless that was kept already or is no number."""
        with suppress(NotFiniteError):
            check_model(self.model)
            self._keep_end()

    def _keep_end(self) -> None:
        rows = self.moments.rows
        is_kept = len(rows) and (rows["number"][-1], rows["timesteps"][-1]) == (
            self.n_units,
            self.model.num_timesteps,
        )
        if not is_kept:
            self._append()

    def _count(self) -> None:
        """Another one is over: keep its map if it is one of those to be kept."""
        self.n_units += 1
        if self.n_units % self.stride:
            return
        self._append()
        if len(self.moments) > self.most:
            self.stride *= 2
            self.moments.keep(self.moments.rows["number"] % self.stride == 0)

    def _append(self) -> None:
        policy = best_actions_of(self.evaluator, self.model)
        if policy is None:
            return
        values = self.evaluator.values(policy)
        log = self.model.logger.name_to_value if self.n_units else {}
        self.moments.append(
            self.n_units,
            self.model.num_timesteps,
            _exploration(self.model),
            *(log.get(name, math.nan) for name in LOGGED.values()),
            _training_return(self.model),
            values,
            policy[0],
        )


class EvaluationMaps(MapRecorder):
    """Told after every evaluation, it keeps a map then."""

    unit = "evaluation"

    def _on_step(self) -> bool:
        self._count()
        return True


class UpdateMaps(MapRecorder, BlockCallback):
    """Keeps a map after every training on what was collected: what an agent of the library learns.

    It acts where a rollout begins, so that compiled networks train as with any callback that does.
    """

    unit = "update"

    def __init__(self, evaluator: ExactEvaluator) -> None:
        super().__init__(evaluator)
        self._seen = 0  # updates, as the agent counts them: several in a training

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._seen = _n_updates(self.model)

    def _on_rollout_start(self) -> None:
        if (seen := _n_updates(self.model)) != self._seen:
            self._seen = seen
            self._count()

    def _on_step(self) -> bool:
        return True

    def _keep_end(self) -> None:
        self._on_rollout_start()  # the last training comes after the last rollout
        super()._keep_end()


def moment_type(n_states: int) -> np.dtype[np.void]:
    """The type of what is kept of a moment."""
    return np.dtype(
        [
            ("number", np.int64),  # of the unit that it follows; 0 before the training
            ("timesteps", np.int64),
            ("exploration", np.float64),  # nan where the agent has no such rate
            *((name, np.float64) for name in LOGGED),  # of the last training; nan for none
            ("training_return", np.float64),  # mean of the last episodes, nan for none
            ("values", np.float64, (n_states,)),
            ("actions", np.int64, (n_states,)),
        ]
    )


def tells_updates(agent: Any) -> bool:
    """Whether callbacks hear of each of its trainings."""
    return isinstance(agent, OnPolicyAlgorithm | OffPolicyAlgorithm)


def can_be_mapped(evaluator: ExactEvaluator) -> bool:
    """Whether there are few enough states to look at."""
    return evaluator.model.n_states <= MAX_STATES


def _n_updates(agent: Any) -> int:
    return int(agent._n_updates)


def _exploration(agent: Any) -> float:
    """What the agent's schedule of exploration says now; its rate is set with the first step."""
    schedule = getattr(agent, "exploration_schedule", None)
    return math.nan if schedule is None else float(schedule(agent._current_progress_remaining))


def _training_return(agent: Any) -> float:
    episodes = [episode["r"] for episode in agent.ep_info_buffer or ()]
    return float(np.mean(episodes)) if episodes else math.nan
