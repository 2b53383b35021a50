"""Results of the runs on bandits, from batches and from runs of their own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from experiments.bandit_batches import (
    STATISTICS_FILE,
    check_pulls,
    read_run,
    stacked_statistics,
)
from experiments.planned_runs import PlannedRun
from experiments.pull_statistics import PullStatistics
from experiments.run_figures import read_outcome
from pipeline.file_digests import DamagedFileError
from pipeline.pull_recording import PULLS_FILE


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
