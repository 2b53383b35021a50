"""All runs of one bandit agent as one piece of work: each a fresh agent and one episode."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from agents.bandits.batch import run_batch
from agents.bandits.batch_result import BatchResult
from agents.bandits.one_by_one import run_one_by_one
from agents.compiled.compile_envs import NotCompilable
from experiments.bandit_results import STATISTICS_FILE, suited, true_means
from experiments.pull_statistics import PullStatistics, pull_statistics
from machine_code.compiling import compile_timer
from machine_code.work_time import WorkTime
from pipeline.environments import make_single_env
from pipeline.finite_numbers import NotFiniteError, is_finite
from pipeline.preparation import algorithm_kwargs
from pipeline.run_folder import FINISHED, Run
from pipeline.run_record import recorded_machine, recorded_versions, write_settings
from pipeline.train_spec import TrainSpec


def do_batch(spec: TrainSpec, n_runs: int, run: Run, command: str) -> None:
    """Do ``n_runs`` runs, from the spec's seed on, and leave their statistics in the run folder."""
    started = WorkTime.now()
    with compile_timer() as time_compiling:
        result, engine = _run(spec, n_runs)
    _check_rewards(result, spec.seed)
    env = make_single_env(spec)
    try:
        statistics = _statistics(env, result)
    finally:
        env.close()
    statistics.save(run.path / STATISTICS_FILE)
    write_settings(run, spec, command)
    run.end(
        state=FINISHED,
        env_name=run.env_name,
        spec=spec.as_data(),
        n_runs=n_runs,
        n_timesteps=len(result.arms[0]),
        versions=recorded_versions(),
        machine=recorded_machine(),
        engine=engine,
        **(WorkTime.now() - started - time_compiling()).as_data(),
    )


def _run(spec: TrainSpec, n_runs: int) -> tuple[BatchResult, str]:
    arguments: tuple[Any, ...] = (
        spec.algo,
        algorithm_kwargs(spec),
        spec.env_id,
        spec.hyperparams.env_kwargs,
        range(spec.seed, spec.seed + n_runs),
        spec.hyperparams.n_timesteps,
    )
    try:
        return run_batch(*arguments), "compiled batch"
    except NotCompilable as reason:
        return run_one_by_one(*arguments), f"one by one: {reason}"


def _check_rewards(result: BatchResult, first_seed: int) -> None:
    """Refuse rewards that are not finite, before anything is judged by them."""
    for seed, rewards in enumerate(result.rewards, start=first_seed):
        if not is_finite(rewards):
            pull = int(np.argmin(np.isfinite(rewards)))
            what = f"reward of seed {seed} at step {pull + 1:,}"
            raise NotFiniteError(what, float(rewards[pull]))


def _statistics(env: gym.Env[Any, Any], result: BatchResult) -> PullStatistics:
    bandit: Any = env.unwrapped
    statistics = pull_statistics(
        result.arms,
        result.rewards,
        result.regrets,
        result.contexts,
        bandit.n_arms,
        max(bandit.n_contexts, 1),
        result.estimates,
        true_means(env),
        result.moments,
        result.posteriors,
    )
    return suited(statistics, bandit)
