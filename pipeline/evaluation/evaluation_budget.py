"""Evaluation that is sampled, for no more than it is worth beside the training.

It goes by steps and never by the clock, so that the same seed gives the same files anywhere.
"""

from __future__ import annotations

import math

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from pipeline.evaluation.bracketed import bracketed_yardstick
from pipeline.evaluation.sampled import Evaluation, evaluate, evaluation_seed
from pipeline.train_spec import TrainSpec

# Steps of evaluation for one of training, so that they take a fifth of its time or less: by a
# network, which learns for longer than it plays, and by a table; and the same where training runs
# on compiled code, which evaluation does not. Figures: `benchmarks/evaluation_share.py`.
SHARES = {"network": 1 / 4, "table": 1 / 100}
SHARES_COMPILED = {"network": 1 / 32, "table": 1 / 2500}
# Of short trainings; half a second in most environments.
STEPS_IN_ANY_CASE = 10_000
# The final evaluation has the rest.
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
        self._usual_length = 1.0

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
            allowed = allowed_steps(planned, share_of(model)) * min(progress, 1.0)
            self._left = allowed * PART_DURING_TRAINING - self.n_steps
        return STAGES[0] * self._usual_length <= self._left

    def __call__(self, model: BaseAlgorithm) -> Evaluation:
        """An evaluation during training."""
        stages = STAGES if self.n_episodes is None else (self.n_episodes,)
        return self._evaluate(model, stages, PRECISION, self._left, purpose=1)

    def at_the_end(self, model: BaseAlgorithm) -> Evaluation:
        """The final evaluation, by episodes of its own."""
        stages = STAGES_AT_THE_END if self.n_final is None else (self.n_final,)
        n_trained = model.num_timesteps - model._num_timesteps_at_start
        left = allowed_steps(n_trained, share_of(model)) - self.n_steps
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
        found = evaluate(model, self.env, stages[0], seed)
        for n_episodes in stages[1:]:
            n_more = n_episodes - len(found.returns)
            if is_sure(found, precision) or found.lengths.sum() + n_more * found.mean_length > most:
                break
            # Not seeded again, the environments go on to other episodes.
            found = found.joined(evaluate(model, self.env, n_more, seed=None))
        self.n_steps += int(found.lengths.sum())
        self._usual_length = found.mean_length
        return found.measured_by(self.yardstick)


def share_of(model: BaseAlgorithm) -> float:
    """Steps of evaluation for one of the model's training."""
    is_compiled = getattr(model, "engine_in_use", "").startswith("compiled")
    shares = SHARES_COMPILED if is_compiled else SHARES
    return shares["network" if is_network(model) else "table"]


def allowed_steps(n_trained: float, share: float) -> float:
    """Steps that all evaluations of a training of so many may take."""
    return max(share * n_trained, STEPS_IN_ANY_CASE)


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


def is_network(model: BaseAlgorithm) -> bool:
    """Whether the agent's policy has weights."""
    policy = getattr(model, "policy", None)
    return isinstance(policy, th.nn.Module) and next(policy.parameters(), None) is not None
