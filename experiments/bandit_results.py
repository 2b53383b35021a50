"""Results of the runs on bandits, from batches and from runs of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from experiments.planned_runs import PlannedRun
from experiments.pull_statistics import PullStatistics, pull_statistics
from experiments.run_figures import read_outcome
from mdp.array_types import Floats
from pipeline.digests import DamagedFileError, read_arrays
from pipeline.environments import make_single_env
from pipeline.runs import PULLS_FILE, Run
from pipeline.train_spec import TrainSpec

STATISTICS_FILE = "pull_statistics.npz"
_PULLS = ("arms", "rewards", "regrets")  # what figures are made of, beside contexts


def read_pulls(finished: Sequence[PlannedRun]) -> dict[tuple[str, str], PullStatistics]:
    """Figures by pull of all runs on bandits."""
    batches = [run for run in finished if run.is_batch]
    pulls = {
        (run.agent, run.environment): PullStatistics.load(run.path / STATISTICS_FILE)
        for run in batches
    }
    one_by_one: dict[tuple[str, str], list[PlannedRun]] = {}
    for run in finished:
        if run.run.files.matching(PULLS_FILE):
            one_by_one.setdefault((run.agent, run.environment), []).append(run)
    for labels, runs in one_by_one.items():
        pulls[labels] = stacked_statistics(runs[0].spec, [run.path for run in runs])
    return pulls


def batch_rows(planned: PlannedRun) -> list[dict[str, Any]]:
    """A row of the summary for each run of a batch.

    Raises:
        DamagedFileError: if a file of the batch is missing or changed, or holds anything else.
    """
    info = read_outcome(planned.run, ("seconds",))
    cpu_seconds = info.get("cpu_seconds")
    path = planned.path / STATISTICS_FILE
    pulls = PullStatistics.load(path)
    if pulls.total_reward.size != planned.n_runs or info["seconds"] is None:
        raise DamagedFileError(path, "is damaged: it is not of as many runs")
    shared = {
        "agent": planned.agent,
        "algo": planned.spec.algo,
        "environment": planned.environment,
        "env_id": planned.spec.env_id,
        "n_timesteps": planned.spec.hyperparams.n_timesteps,
        "n_episodes": 1,
        "seconds": info["seconds"] / planned.n_runs,
        "cpu_seconds": None if cpu_seconds is None else cpu_seconds / planned.n_runs,
        "engine": info.get("engine"),
        "path": str(planned.path),
    }
    return [
        {
            **shared,
            "seed": seed,
            "training": reward,
            "last_episodes": reward,
            "regret": regret,
        }
        for seed, (reward, regret) in enumerate(
            zip(pulls.total_reward.tolist(), pulls.total_regret.tolist(), strict=True),
            start=planned.seed,
        )
    ]


def run_regret(planned: PlannedRun) -> float | None:
    """The regret of a run of its own, or None where it was on no bandit.

    Raises:
        DamagedFileError: if the file of its pulls is missing or changed, or holds anything else.
    """
    files = planned.run.files
    if not files.matching(PULLS_FILE):
        return None
    if files.digests is None:
        check_pulls(planned.spec, planned.path)
    pulls = read_run(planned.path, planned.spec.hyperparams.n_timesteps)
    return float(pulls["regrets"].sum())


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
        return suited(statistics, bandit)
    finally:
        env.close()


def suited(statistics: PullStatistics, bandit: Any) -> PullStatistics:
    """Figures without simple regret where no arm could be recommended.

    That is where the worth of arms moves, or goes by a vector.
    """
    if bandit.n_contexts > 0 and not getattr(bandit, "drift_std", 0.0) > 0:
        return statistics
    return replace(statistics, simple_regret=np.full_like(statistics.simple_regret, np.nan))


def true_means(env: gym.Env[Any, Any]) -> Floats | None:
    """Means of the arms by context, shape (n_contexts, n_arms), where each run has the same."""
    bandit: Any = env.unwrapped
    moves = getattr(bandit, "redraws", False) or getattr(bandit, "drift_std", 0.0) > 0
    means = getattr(bandit, "means", None)
    return None if moves or means is None else np.array(means, dtype=np.float64)
