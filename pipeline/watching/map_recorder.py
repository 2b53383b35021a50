"""Keeps what an agent does in every state, at each evaluation: how it learns, seen from far."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from mdp import state_values
from mdp.array_types import Floats, Ints
from pipeline.evaluation.exact import ExactEvaluator
from pipeline.evaluation.value_maps import MAX_STATES, best_actions_of


class MapRecorder(BaseCallback):
    """Told after every evaluation, it keeps the greedy policy and what each state is worth then.

    Args:
        evaluator: of the environment that the agent is judged on.

    Attributes:
        moments: of each, environment steps, how much the agent explores (None where it has no such
            rate), values of shape (S,) and actions of shape (S,).
    """

    def __init__(self, evaluator: ExactEvaluator) -> None:
        super().__init__()
        self.evaluator = evaluator
        self.moments: list[tuple[int, float | None, Floats, Ints]] = []

    def _on_training_start(self) -> None:
        self.record()

    def _on_step(self) -> bool:
        self.record()
        return True

    def record(self) -> None:
        """Keep what the agent does now, unless that was kept already."""
        timesteps = self.model.num_timesteps
        if self.moments and self.moments[-1][0] >= timesteps:
            return
        policy = best_actions_of(self.evaluator, self.model)
        if policy is not None:
            values = state_values(self.evaluator.model, policy, self.evaluator.horizon)
            self.moments.append((timesteps, _exploration(self.model), values, policy[0]))


def _exploration(agent: Any) -> float | None:
    """What the agent's schedule of exploration says now; its rate is set with the first step."""
    schedule = getattr(agent, "exploration_schedule", None)
    return None if schedule is None else float(schedule(agent._current_progress_remaining))


def can_be_mapped(evaluator: ExactEvaluator) -> bool:
    """Whether there are few enough states to look at."""
    return evaluator.model.n_states <= MAX_STATES
