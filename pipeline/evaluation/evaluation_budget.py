"""Evaluation that is sampled, for no more than it is worth beside the training.

It goes by steps and never by the clock, so that the same seed gives the same files anywhere.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from pipeline.evaluation.bracketed import bracketed_yardstick
from pipeline.evaluation.evaluation_shares import allowed_steps, shares_of
from pipeline.evaluation.sampled import Evaluation, evaluate, evaluation_seed
from pipeline.train_spec import TrainSpec

if TYPE_CHECKING:
    from pipeline.evaluation.compiled_play import CompiledCopy

# The final evaluation has the rest, and no less where those before took more than they had.
PART_DURING_TRAINING = 1 / 2

# Episodes of an evaluation: the first number, and the next until the standard error is small.
STAGES = (5, 10, 20)
STAGES_AT_THE_END = (10, 25, 50, 100)
LEAST_SURE = 10
# Relative to the mean return.
PRECISION = 0.05
PRECISION_AT_THE_END = 0.01


class SampledEvaluator:
    """Plays episodes: as many as are asked for, or as few as will do.

    Args:
        spec: the run.
        env: environments to play on, with a time limit.

    Attributes:
        n_steps: environment steps that it has taken, in all evaluations.
    """

    def __init__(self, spec: TrainSpec, env: VecEnv) -> None:
        self.env = env
        self.yardstick = bracketed_yardstick(spec)
        self.seed = spec.seed
        self.n_episodes, self.n_final = spec.eval_episodes, spec.final_episodes
        # Whoever says when to evaluate, or how long, gets that.
        self.is_limited = spec.eval_episodes is None and spec.eval_freq is None
        self.training_steps = spec.hyperparams.n_timesteps
        self.training_episodes = spec.hyperparams.n_episodes
        self.n_steps = 0
        self._left = math.inf
        self._last_length: float | None = None

    def can_afford(self, model: BaseAlgorithm, n_episodes: int) -> bool:
        """Whether the training has come far enough for another evaluation.

        Args:
            model: the agent.
            n_episodes: of training so far.
        """
        if self.is_limited:
            n_trained = model.num_timesteps - model._num_timesteps_at_start
            progress = n_trained / (self.training_steps or math.inf)
            if self.training_episodes is not None:
                progress = n_episodes / self.training_episodes
            planned = n_trained / progress if progress > 0 else 0.0
            allowed = self._allowed(model, planned) * min(progress, 1.0)
            self._left = allowed * PART_DURING_TRAINING - self.n_steps
        return STAGES[0] * self._usual_length(model) <= self._left

    def __call__(self, model: BaseAlgorithm) -> Evaluation:
        """An evaluation during training."""
        stages = STAGES if self.n_episodes is None else (self.n_episodes,)
        return self._evaluate(model, stages, PRECISION, self._left, purpose=1)

    def at_the_end(self, model: BaseAlgorithm) -> Evaluation:
        """The final evaluation, by episodes of its own."""
        n_trained = model.num_timesteps - model._num_timesteps_at_start
        allowed = self._allowed(model, n_trained)
        left = max(allowed - self.n_steps, allowed * (1 - PART_DURING_TRAINING))
        stages = STAGES_AT_THE_END if self.n_final is None else (self.n_final,)
        if self.n_final is None and not self._is_known_to_fit(stages[0], left):
            stages = (STAGES[0], *stages)
        return self._evaluate(model, stages, PRECISION_AT_THE_END, left, purpose=2)

    def _evaluate(
        self,
        model: BaseAlgorithm,
        stages: tuple[int, ...],
        precision: float,
        most: float,
        purpose: int,
    ) -> Evaluation:
        """Play episodes, until the mean is sure enough or more of them would be too many steps."""
        seed = evaluation_seed(self.seed, purpose)
        copy = self._compiled_copy(model)
        found = self._play(model, copy, stages[0], seed)
        for n_episodes in stages[1:]:
            n_more = n_episodes - len(found.returns)
            if is_sure(found, precision) or found.lengths.sum() + n_more * found.mean_length > most:
                break
            # Not seeded again, the environments go on to other episodes.
            found = found.joined(self._play(model, copy, n_more, None))
        self.n_steps += int(found.lengths.sum())
        self._last_length = found.mean_length
        return found.measured_by(self.yardstick)

    def _allowed(self, model: BaseAlgorithm, n_trained: float) -> float:
        is_compiled = self._compiled_copy(model) is not None
        return allowed_steps(n_trained, shares_of(model, plays_compiled=is_compiled))

    def _is_known_to_fit(self, n_episodes: int, left: float) -> bool:
        return self._last_length is not None and n_episodes * self._last_length <= left

    def _usual_length(self, model: BaseAlgorithm) -> float:
        """Steps of an episode: of those evaluated last, or else of training's last ones."""
        if self._last_length is not None:
            return self._last_length
        lengths = [episode["l"] for episode in getattr(model, "ep_info_buffer", None) or ()]
        return float(np.mean(lengths[-STAGES[0] :])) if lengths else 1.0

    def _play(
        self, model: BaseAlgorithm, copy: CompiledCopy | None, n_episodes: int, seed: int | None
    ) -> Evaluation:
        if copy is None:
            return evaluate(model, self.env, n_episodes, seed)
        from pipeline.evaluation.compiled_play import evaluate_compiled

        return evaluate_compiled(model, copy, n_episodes, seed)

    def _compiled_copy(self, model: BaseAlgorithm) -> CompiledCopy | None:
        """The environments in compiled code, if it is that what the agent was trained on."""
        if getattr(model, "engine_in_use", "") != "compiled":
            return None
        from pipeline.evaluation.compiled_play import compiled_copy

        return compiled_copy(self.env)


def is_sure(evaluation: Evaluation, precision: float) -> bool:
    """Whether the standard error of the mean return is small beside it.

    Of fewer than ten episodes that cannot be said: the first five may be alike by chance.
    """
    n_episodes = len(evaluation.returns)
    error = float(np.std(evaluation.returns)) / math.sqrt(max(n_episodes - 1, 1))
    return n_episodes >= LEAST_SURE and error <= precision * abs(evaluation.mean_return)


def n_environments(n_eval_envs: int, n_episodes: int | None) -> int:
    """How many environments to play on at once: no more than there are episodes."""
    return min(n_eval_envs, STAGES[0] if n_episodes is None else n_episodes)
