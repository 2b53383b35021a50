"""Evaluates agents by episodes on the original environment, not on a training variant.

The number of evaluation steps depends on the number of training steps and never on the clock, so
that the same seed gives the same files on every machine. Agents that train in compiled code are
evaluated in compiled code too.
"""

from __future__ import annotations

import math
from contextlib import closing, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
from stable_baselines3 import A2C
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from rl_yardstick.agents.policies import is_network
from rl_yardstick.envs.brackets import may_have_bracket
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation, Yardstick, bracket_of
from rl_yardstick.pipeline.finite_numbers import check_numbers
from rl_yardstick.pipeline.playing import play_episodes
from rl_yardstick.pipeline.spec import TrainSpec


def evaluate(
    model: BaseAlgorithm, env: VecEnv, n_episodes: int, seed: int | None, deterministic: bool = True
) -> Evaluation:
    """Play ``n_episodes``, determined by the seed; with None, environments are not reseeded."""
    # Planners, for example, do not count steps.
    when = f"in the evaluation at step {getattr(model, 'num_timesteps', 0):,}"
    if seed is not None:
        env.seed(seed)
    played = play_episodes(model, env, n_episodes, deterministic=deterministic, when=when)
    returns, lengths, successes = zip(*played, strict=True)
    return Evaluation(
        np.array(returns, dtype=np.float64),
        np.array(lengths, dtype=np.int64),
        None if None in successes else np.array(successes, dtype=np.bool_),
    )


def evaluation_seed(seed: int, purpose: int) -> int:
    """A seed distinct from training's; purpose 1: during training, 2: at its end, 3: playing."""
    stream = np.random.SeedSequence(seed, spawn_key=(purpose,))
    return int(stream.generate_state(1)[0] % 2**31)


def bracketed_yardstick(spec: TrainSpec) -> Yardstick | None:
    """The known bracket of the evaluation environment's optimum, or None."""
    if spec.vec_env_wrapper or not may_have_bracket(spec.env_id):
        return None
    with closing(make_single_env(spec)) as env:
        return bracket_of(env)


# Evaluation steps per training step: for every training, and for short ones, up to
# `STEPS_AT_FIRST` evaluation steps.
Shares = tuple[float, float]

# For networks and for tables, by what is compiled. Chosen by the time of an evaluation step
# relative to a training step, so that evaluations take at most a fifth of the training time.
# Figures: docs/benchmarks.md.
SHARES = {
    "nothing": ((1 / 4, 1 / 2), (1 / 100, 1 / 5)),
    "training and evaluation": ((1 / 4, 1 / 2), (1 / 10, 1 / 2)),
    "training": ((1 / 32, 1 / 32), (1 / 2500, 1 / 2500)),
    "learning": ((1 / 32, 1 / 6), (1 / 32, 1 / 6)),  # the environments are in Python
}
# A2C learns once from each step, which takes no longer than playing it.
LIGHT_NETWORK = (1 / 10, 1 / 10)
STEPS_AT_FIRST = 10_000
# A tenth of a second in most environments.
STEPS_IN_ANY_CASE = 2_000


def shares_of(model: BaseAlgorithm, *, plays_compiled: bool) -> Shares:
    """The evaluation steps per training step of an agent."""
    engine, compiled = getattr(model, "engine_in_use", "") or "", "nothing"
    if engine.startswith("compiled but"):
        compiled = "learning"
    elif engine.startswith("compiled"):
        compiled = "training and evaluation" if plays_compiled else "training"
    elif isinstance(model, A2C) and is_network(model):
        return LIGHT_NETWORK
    of_network, of_table = SHARES[compiled]
    return of_network if is_network(model) else of_table


# Of the allowed steps; the final evaluation gets the rest, but at least the other half.
PART_DURING_TRAINING = 1 / 2

# Episodes of an evaluation: first this many, then more until the standard error is small.
STAGES = (5, 10, 20)
STAGES_AT_THE_END = (10, 25, 50, 100)
LEAST_SURE = 10
# Of the standard error, relative to the mean return.
PRECISION = 0.05
PRECISION_AT_THE_END = 0.01


class SampledEvaluator:
    """Evaluates by episodes: a given number, or as few as are precise enough."""

    def __init__(self, spec: TrainSpec, env: VecEnv, yardstick: Yardstick | None = None) -> None:
        self.env, self.yardstick = env, yardstick or bracketed_yardstick(spec)
        self.spec = spec
        self.n_steps = 0  # in all evaluations
        self._left = math.inf
        self._last_length: float | None = None

    def can_afford(self, model: BaseAlgorithm, n_episodes: int) -> bool:
        """Whether the training has done enough steps for another evaluation."""
        n_trained = model.num_timesteps - model._num_timesteps_at_start
        # Explicit intervals or numbers of episodes take precedence over the limit.
        if self.spec.eval_episodes is None and self.spec.eval_freq is None:
            progress = n_trained / (self.spec.n_timesteps or math.inf)
            if self.spec.n_episodes is not None:
                progress = n_episodes / self.spec.n_episodes
            planned = n_trained / progress if progress > 0 else 0.0
            allowed = self._allowed(model, planned) * min(progress, 1.0)
            self._left = allowed * PART_DURING_TRAINING - self.n_steps
        length = self._last_length
        if length is None:  # then of training's last episodes, or of the first ones so far
            lengths = [episode["l"] for episode in getattr(model, "ep_info_buffer", None) or ()]
            length = float(np.mean(lengths[-STAGES[0] :] or n_trained / model.n_envs))
        return STAGES[0] * length <= self._left

    def __call__(self, model: BaseAlgorithm) -> Evaluation:
        """Evaluate during training."""
        n_episodes, seed = self.spec.eval_episodes, evaluation_seed(self.spec.seed, 1)
        stages = STAGES if n_episodes is None else (n_episodes,)
        return self._evaluate(model, stages, PRECISION, self._left, seed)

    def at_the_end(self, model: BaseAlgorithm) -> Evaluation:
        """Evaluate at the end of training, on separate episodes."""
        n_trained = model.num_timesteps - model._num_timesteps_at_start
        allowed = self._allowed(model, n_trained)
        left = max(allowed - self.n_steps, allowed * (1 - PART_DURING_TRAINING))
        n_episodes, seed = self.spec.final_episodes, evaluation_seed(self.spec.seed, 2)
        stages = STAGES_AT_THE_END if n_episodes is None else (n_episodes,)
        if n_episodes is None and stages[0] * (self._last_length or math.inf) > left:
            stages = (STAGES[0], *stages)
        return self._evaluate(model, stages, PRECISION_AT_THE_END, left, seed)

    def _evaluate(
        self, model: BaseAlgorithm, stages: tuple[int, ...], within: float, most: float, seed: int
    ) -> Evaluation:
        """Play episodes until the mean is precise enough, or the allowed steps are used up."""
        copy = self._compiled_copy(model)

        def play(n_episodes: int, seed: int | None) -> Evaluation:
            if copy is None:
                return evaluate(model, self.env, n_episodes, seed)
            return evaluate_compiled(model, copy, n_episodes, seed)

        found = play(stages[0], seed)
        for n_episodes in stages[1:]:
            n_more = n_episodes - len(found.returns)
            error = found.std_return / math.sqrt(max(len(found.returns) - 1, 1))
            is_sure = error <= within * abs(found.mean_return) and len(found.returns) >= LEAST_SURE
            if is_sure or found.lengths.sum() + n_more * found.mean_length > most:
                break
            # Without a new seed, the environments continue with other episodes.
            found = found.joined(play(n_more, None))
        self.n_steps += int(found.lengths.sum())
        self._last_length = found.mean_length
        return replace(found, yardstick=self.yardstick)

    def _allowed(self, model: BaseAlgorithm, n_trained: float) -> float:
        """The number of steps that all evaluations of a training together may take."""
        is_compiled = self._compiled_copy(model) is not None
        usual, at_first = shares_of(model, plays_compiled=is_compiled)
        at_first = min(at_first * n_trained, STEPS_AT_FIRST)
        return max(usual * n_trained, at_first, STEPS_IN_ANY_CASE)

    def _compiled_copy(self, model: BaseAlgorithm) -> Any:
        """The compiled evaluation environments, if the agent trains in compiled code."""
        if getattr(model, "engine_in_use", "") != "compiled":
            return None
        from rl_yardstick.agents.compiled.engine import compiled_copy

        return compiled_copy(self.env)


def evaluate_compiled(
    model: BaseAlgorithm, copy: Any, n_episodes: int, seed: int | None
) -> Evaluation:
    """Like `evaluate`, in compiled code; the library's network decides near ties."""
    from rl_yardstick.agents.compiled import engine
    from rl_yardstick.agents.networks.perceptron import one_thread

    if seed is not None:
        copy[0].seed(seed)
    with one_thread() if is_network(model) else nullcontext():
        found = engine.play_episodes(model, copy, n_episodes)
    check_numbers(found.returns, "return", f"in the evaluation at step {model.num_timesteps:,}")
    return Evaluation(found.returns.copy(), found.lengths, None)
