"""The results of the runs of a study, as tables with one row for each observation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.bandits import PullStatistics, batch_rows, read_pulls, run_regret
from experiments.plan import PlannedRun
from experiments.run_files import (
    TRAINING_POINTS,
    Curve,
    Episodes,
    evaluation_curve,
    joined,
    read_episodes,
    read_outcome,
    read_value_maps,
    training_curve,
)
from experiments.study import StudySpec
from mdp.array_types import Floats
from pipeline.digests import DamagedFileError
from pipeline.signs_of_life import Tell, tell_nobody
from verdicts import (
    Band,
    area_under_curve,
    curve_band,
    on_grid,
    shared_grid,
    steps_to_stay,
    steps_to_threshold,
)

LAST_EPISODES = 100


@dataclass(frozen=True)
class LeftOut:
    """A run that is there, and counts for nothing, since a file of it is damaged."""

    planned: PlannedRun  #: the run
    reason: str  #: which file, and what of it, in one line


@dataclass(frozen=True)
class RunResults:
    """What one finished run, or one batch of them, has to say."""

    rows: list[dict[str, Any]]  #: of the summary, see `RUN_COLUMNS`
    curves: list[Curve] = field(default_factory=list)  #: its learning curves


@dataclass(frozen=True)
class StudyResults:
    """A study and its runs."""

    study: StudySpec  #: what was asked for
    root: Path  #: its folder
    summary: pd.DataFrame  #: one row for each finished run, see `RUN_COLUMNS`
    curves: pd.DataFrame  #: learning curves of all runs, see `CURVE_COLUMNS`
    planned: tuple[PlannedRun, ...]  #: all runs of the study, also those that failed
    #: On bandits, figures by pull, by labels of agent and environment.
    pulls: Mapping[tuple[str, str], PullStatistics] = field(default_factory=dict)
    left_out: tuple[LeftOut, ...] = ()  #: the runs that are damaged
    n_unchecked: int = 0  #: how many runs recorded no digests, so that damage in them may go unseen
    finished: tuple[PlannedRun, ...] = ()  #: the runs that the results are of
    #: Of runs that have just failed, the details, by their folders.
    failures: Mapping[Path, str] = field(default_factory=dict)


# Columns of `StudyResults.summary`; returns are undiscounted sums of rewards.
RUN_COLUMNS = (
    "agent",
    "algo",
    "environment",
    "env_id",
    "seed",
    "final",  # return of the final policy
    "final_std",  # standard deviation of an episode's return
    "final_length",
    "success_rate",
    "exact",  # whether these are expectations rather than means of episodes
    "optimum",
    "optimum_at_least",  # where it is bracketed: ``optimum`` is then the upper end
    "baseline",
    "gap",  # optimum minus final
    "score",  # final, with 0 at the best random or constant policy and 1 at the optimum
    "best",  # highest return of an evaluation during training
    "best_timesteps",
    "area",  # mean return over the learning curve
    "training",  # mean return of the training episodes
    "last_episodes",  # of the last 100
    "regret",  # on bandits, best expected rewards less those of the arms pulled, summed up
    "threshold",
    "steps_to_threshold",  # infinite where it was never reached
    "steps_to_stay",  # until it was reached for good
    "episodes_to_threshold",
    "episodes_to_stay",
    "n_timesteps",
    "n_episodes",
    "seconds",
    "cpu_seconds",  # of the run's own process; missing in runs of older versions
    "engine",
    "path",
)

# Columns that have the same name in ``run.json``.
_FIGURES = ("success_rate", "exact", "optimum", "optimum_at_least", "baseline", "gap", "score")


def read_results(
    study: StudySpec,
    planned: Sequence[PlannedRun],
    root: Path,
    tell: Tell = tell_nobody,
    read: Callable[[PlannedRun], RunResults | None] | None = None,
) -> StudyResults:
    """Read all runs that have finished; those whose files are damaged are left out.

    Args:
        study: whose runs they are.
        planned: the runs.
        root: the study's folder.
        tell: told how far it is.
        read: what to read a run with, for those that were read before; by default `read_run`.
    """
    rows, curves, done, left_out = [], [], [], []
    for place, run in enumerate(planned, start=1):
        tell(f"run {place:,} of {len(planned):,}")
        try:
            found = read_run(study, run) if read is None else read(run)
        except DamagedFileError as error:
            left_out.append(LeftOut(run, str(error)))
            continue
        if found is not None:
            rows += found.rows
            curves += found.curves
            done.append(run)
    return StudyResults(
        study,
        root,
        pd.DataFrame(rows, columns=list(RUN_COLUMNS)),
        joined(curves),
        tuple(planned),
        read_pulls(done),
        tuple(left_out),
        sum(run.n_runs for run in done if run.run.files.digests is None),
        tuple(done),
    )


def read_run(study: StudySpec, planned: PlannedRun) -> RunResults | None:
    """What a run has to say, or None where it is not there or has not finished.

    Raises:
        DamagedFileError: if a file that a comparison reads is missing, changed or no such file.
    """
    planned = planned.read()
    planned.check_record()
    if not planned.is_finished:
        return None
    if planned.is_batch:
        return RunResults(batch_rows(planned))
    _check_for_page(study, planned)
    episodes = read_episodes(planned.run)
    evaluations = evaluation_curve(planned, episodes)
    row = _summary_row(study, planned, episodes, evaluations)
    return RunResults([row], [evaluations, training_curve(planned, episodes)])


def _check_for_page(study: StudySpec, planned: PlannedRun) -> None:
    """Make sure of the files that the page opens later: maps, and the agent that is filmed."""
    run, files = planned.run, planned.run.files
    for path in files.matching(run.value_maps_path.name):
        files.check(path)
        if files.digests is None:
            read_value_maps(run)
    if planned.seed == study.first_seed:
        files.check(run.model_path)
        if not run.model_path.exists():
            raise DamagedFileError(run.model_path, "is missing")


def threshold_of(study: StudySpec, env_id: str, final: dict[str, Any]) -> float | None:
    """The return that counts as solved; None where nobody says."""
    import gymnasium as gym

    if study.threshold is not None:
        return study.threshold
    # Of a bracket nobody knows whether its upper end can be reached.
    reachable = final.get("optimum_at_least", final.get("optimum"))
    if "optimum_at_least" in final or reachable is None:
        registered = gym.spec(env_id.rpartition(":")[2]).reward_threshold
        if registered is not None:
            return float(registered)
    if reachable is None:
        return None
    baseline = float(final["baseline"])
    return baseline + 0.95 * (float(reachable) - baseline)


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _summary_row(
    study: StudySpec, planned: PlannedRun, episodes: Episodes, evaluations: Curve
) -> dict[str, Any]:
    info = read_outcome(
        planned.run, ("final", "best_mean_return", "best_timesteps", "n_timesteps", "seconds")
    )
    final = info["final"]
    threshold = threshold_of(study, planned.spec.env_id, final)
    steps, values = evaluations.figures["step"], evaluations.figures["value"]
    reached = stayed = float("nan")
    if threshold is not None and len(steps):
        reached = steps_to_threshold(steps, values, threshold)
        stayed = steps_to_stay(steps, values, threshold)
    return {
        "agent": planned.agent,
        "algo": planned.spec.algo,
        "environment": planned.environment,
        "env_id": planned.spec.env_id,
        "seed": planned.seed,
        "final": final.get("mean_return"),
        "final_std": final.get("std_return"),
        "final_length": final.get("mean_length"),
        **{name: final.get(name) for name in _FIGURES},
        "best": info["best_mean_return"],
        "best_timesteps": info["best_timesteps"],
        "area": area_under_curve(steps, values) if len(steps) else None,
        "training": _mean(episodes.returns),
        "last_episodes": _mean(episodes.returns[-LAST_EPISODES:]),
        "regret": run_regret(planned),
        "threshold": threshold,
        "steps_to_threshold": reached,
        "steps_to_stay": stayed,
        "episodes_to_threshold": _episodes_by(episodes, reached),
        "episodes_to_stay": _episodes_by(episodes, stayed),
        "n_timesteps": info["n_timesteps"],
        "n_episodes": len(episodes.returns),
        "seconds": info["seconds"],
        "cpu_seconds": info.get("cpu_seconds"),
        "engine": info.get("engine"),
        "path": str(planned.path),
    }


def _episodes_by(episodes: Episodes, step: float) -> float:
    reached = np.searchsorted(episodes.steps, step, side="right")
    return float(reached) if np.isfinite(step) else step


# --- Agents over their seeds.

RESAMPLING_SEED = 0  # the same runs give the same figures
CURVE_POINTS = TRAINING_POINTS  # no run has more of training; a figure shows no more of them


def values_over_seeds(results: StudyResults, environment: str, column: str) -> dict[str, Floats]:
    """A column of the summary by agent, shape (n_seeds,); NaN where a run is missing."""
    table = results.summary
    table = table[table["environment"] == environment]
    pivot = table.pivot(index="seed", columns="agent", values=column)
    pivot = pivot.reindex(
        index=results.study.seeds, columns=[a.label for a in results.study.agents]
    )
    return {str(agent): pivot[agent].to_numpy(dtype=np.float64, na_value=np.nan) for agent in pivot}


def curves_by_agent(
    results: StudyResults, environment: str
) -> dict[tuple[str, str], list[pd.DataFrame]]:
    """The learning curve of each run on an environment, by agent and kind."""
    table = results.curves
    table = table[table["environment"] == environment]
    found: dict[tuple[str, str], list[pd.DataFrame]] = {}
    for (agent, kind, _), rows in table.groupby(["agent", "kind", "seed"]):
        found.setdefault((str(agent), str(kind)), []).append(rows)
    return found


def mean_curve(curves: Sequence[pd.DataFrame], by: str) -> tuple[Floats, Band] | None:
    """The mean learning curve of an agent over its seeds.

    Args:
        curves: those of its runs, from `curves_by_agent`.
        by: ``"step"``, ``"episode"`` or ``"seconds"``.

    Returns:
        The points, shape (n,), and the mean there with its interval; None without any run, or where
        one ended before the first point of another.
    """
    runs = [
        (rows[by].to_numpy(dtype=np.float64), rows["value"].to_numpy(dtype=np.float64))
        for rows in curves
    ]
    if not runs or max(points[0] for points, _ in runs) > min(points[-1] for points, _ in runs):
        return None
    grid = shared_grid([points for points, _ in runs], CURVE_POINTS)
    values = np.array([on_grid(points, returns, grid) for points, returns in runs])
    return grid, curve_band(values, seed=RESAMPLING_SEED)
