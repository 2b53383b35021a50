"""All runs of one bandit agent as one piece of work: each a fresh agent and one episode."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from agents.bandits.batch import run_batch
from agents.bandits.batch_result import BatchResult
from agents.bandits.one_by_one import run_one_by_one
from agents.compiled.compile_envs import NotCompilable
from experiments.pull_statistics import PullStatistics, pull_statistics
from mdp.array_types import Floats
from mdp.machine_code import compile_timer
from mdp.work_time import WorkTime
from pipeline.array_files import read_arrays
from pipeline.environments import make_single_env
from pipeline.file_digests import DamagedFileError
from pipeline.finite_numbers import NotFiniteError, is_finite
from pipeline.preparation import algorithm_kwargs
from pipeline.pull_recording import PULLS_FILE
from pipeline.run_folder import FINISHED, Run
from pipeline.run_record import recorded_machine, recorded_versions, write_settings
from pipeline.train_spec import TrainSpec

STATISTICS_FILE = "pull_statistics.npz"
_PULLS = ("arms", "rewards", "regrets")  # what figures are made of, beside contexts


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
    return statistics if _has_best_arms(bandit) else _without_simple_regret(statistics)


def _has_best_arms(bandit: Any) -> bool:
    """Whether an arm could be recommended: not where its worth moves, or goes by a vector."""
    return bandit.n_contexts > 0 and not getattr(bandit, "drift_std", 0.0) > 0


def _without_simple_regret(statistics: PullStatistics) -> PullStatistics:
    return replace(statistics, simple_regret=np.full_like(statistics.simple_regret, np.nan))


def true_means(env: gym.Env[Any, Any]) -> Floats | None:
    """Means of the arms by context, shape (n_contexts, n_arms), where each run has the same."""
    bandit: Any = env.unwrapped
    moves = getattr(bandit, "redraws", False) or getattr(bandit, "drift_std", 0.0) > 0
    means = getattr(bandit, "means", None)
    return None if moves or means is None else np.array(means, dtype=np.float64)


def read_run(folder: Path, n_timesteps: int | None) -> dict[str, NDArray[Any]]:
    """The pulls of a run of its own in the order of time, each of shape (n_pulls,).

    Agents that collect whole rollouts go on beyond ``n_timesteps``; that is left out.

    Raises:
        DamagedFileError: if their file is missing or changed, or holds anything else.
    """
    return {name: array.T.ravel()[:n_timesteps] for name, array in _pulls(folder).items()}


def _pulls(folder: Path) -> dict[str, NDArray[Any]]:
    path = folder / PULLS_FILE
    arrays = read_arrays(path, Run(folder, "").files.read(path))
    lacking = [name for name in _PULLS if name not in arrays]
    if lacking:
        raise DamagedFileError(path, f"is damaged: it lacks {lacking[0]}")
    shape = arrays["arms"].shape
    if len(shape) != 2 or not arrays["arms"].size:
        raise DamagedFileError(path, "is damaged: it has not one row for each environment")
    if any(array.shape != shape for array in arrays.values()):
        raise DamagedFileError(path, "is damaged: its arrays do not fit each other")
    for name in ("arms", "contexts"):
        numbers = arrays.get(name)
        if numbers is not None and (numbers.dtype.kind not in "iu" or (numbers < 0).any()):
            raise DamagedFileError(path, f"is damaged: {name} are no numbers from 0 on")
    return arrays


def check_pulls(spec: TrainSpec, folder: Path) -> None:
    """Make sure that what a run pulled is there in the environment of its spec.

    Raises:
        DamagedFileError: if it is not.
    """
    pulls = read_run(folder, spec.hyperparams.n_timesteps)
    env = make_single_env(spec)
    try:
        bandit: Any = env.unwrapped
        sizes = {"arms": bandit.n_arms, "contexts": bandit.n_contexts}
    finally:
        env.close()
    for name, size in sizes.items():
        if size > 0 and name in pulls and pulls[name].max() >= size:
            raise DamagedFileError(folder / PULLS_FILE, f"is damaged: {name} are of another bandit")


def stacked_statistics(spec: TrainSpec, folders: list[Path]) -> PullStatistics:
    """The same for runs that were done one by one, from the pulls in their folders."""
    runs = [read_run(folder, spec.hyperparams.n_timesteps) for folder in folders]
    n_pulls = min(len(run["arms"]) for run in runs)
    env = make_single_env(spec)
    try:
        bandit: Any = env.unwrapped
        n_contexts = max(bandit.n_contexts, 1)
        stacked = {name: np.stack([run[name][:n_pulls] for run in runs]) for name in runs[0]}
        statistics = pull_statistics(
            stacked["arms"],
            stacked["rewards"],
            stacked["regrets"],
            stacked["contexts"] if n_contexts > 1 and "contexts" in stacked else None,
            bandit.n_arms,
            n_contexts,
            true_means=true_means(env),
        )
        return statistics if _has_best_arms(bandit) else _without_simple_regret(statistics)
    finally:
        env.close()
