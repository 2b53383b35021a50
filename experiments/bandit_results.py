"""Results of the runs on bandits, from batches and from runs of their own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from experiments.bandit_batches import STATISTICS_FILE, read_run, stacked_statistics
from experiments.pull_statistics import PullStatistics
from experiments.study_plan import PlannedRun
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
        if (run.path / PULLS_FILE).exists():
            one_by_one.setdefault((run.agent, run.environment), []).append(run)
    for labels, runs in one_by_one.items():
        pulls[labels] = stacked_statistics(runs[0].spec, [run.path for run in runs])
    return pulls


def batch_rows(planned: PlannedRun, pulls: PullStatistics) -> list[dict[str, Any]]:
    """A row of the summary for each run of a batch."""
    info = planned.run.read_info()
    shared = {
        "agent": planned.agent,
        "algo": planned.spec.algo,
        "environment": planned.environment,
        "env_id": planned.spec.env_id,
        "n_timesteps": planned.spec.hyperparams.n_timesteps,
        "n_episodes": 1,
        "seconds": info["seconds"] / planned.n_runs,
        "engine": info["engine"],
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
            zip(pulls.total_reward.tolist(), pulls.total_regret.tolist(), strict=True)
        )
    ]


def run_regret(planned: PlannedRun) -> float | None:
    """The regret of a run of its own, or None where it was on no bandit."""
    if not (planned.path / PULLS_FILE).exists():
        return None
    pulls = read_run(planned.path, planned.spec.hyperparams.n_timesteps)
    return float(pulls["regrets"].sum())
