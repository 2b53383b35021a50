"""Reads the results of a study's finished runs, as tables with one row per observation."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

from rl_yardstick.experiments.bandits import STATISTICS_FILE, PullStatistics, read_pulls, run_regret
from rl_yardstick.experiments.plan import Labels, PlannedRun
from rl_yardstick.experiments.study import AS_IT_IS, SHIPPED, StudySpec
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import UserError, as_user_error, one_line
from rl_yardstick.pipeline.evaluation.yardstick import with_memory
from rl_yardstick.pipeline.files import MAX_TABLE, read_arrays, read_bytes
from rl_yardstick.pipeline.run import MEANINGS, RECORD, Episodes, read_episodes
from rl_yardstick.verdicts import steps_to_threshold

# --- the files of one run -------------------------------------------------------------------------


def read_evaluations(path: Path) -> tuple[Floats, Floats]:
    """Read steps and mean returns in an ``evaluations.npz``, each (n,), if it exists."""
    if not path.exists():
        return np.empty(0), np.empty(0)
    arrays = read_arrays(path, {"timesteps": "n", "results": "n episodes"})
    return arrays["timesteps"].astype(np.float64), arrays["results"].mean(axis=1, dtype=np.float64)


def read_compared(folder: Path) -> dict[str, Floats]:
    """Read the columns of the diagnosis that `pipeline.evaluation.critics` wrote."""
    path = folder / "diagnosis.csv"
    with as_user_error(f"{path} is damaged", ValueError):
        table = pd.read_csv(io.BytesIO(read_bytes(path, MAX_TABLE)), dtype=np.float64)
        return {name: table[name].to_numpy() for name in ("timesteps", *MEANINGS) if name in table}


# --- learning curves ------------------------------------------------------------------------------

TRAINING_POINTS = 100  # the most points of a run, and of a mean curve

# Columns of `StudyResults.curves`. Each row is an evaluation, or the mean return of consecutive
# training episodes at the end of the last one. ``kind`` is "evaluation" or "training".
_LABELS = ("agent", "environment", "seed", "kind")
CURVE_COLUMNS = (*_LABELS, "step", "episode", "seconds", "value")

Curve = dict[str, Any]  # of one run: labels, and the other columns, each of shape (n,)


def evaluation_curve(
    planned: PlannedRun, episodes: Episodes, steps: Floats, returns: Floats
) -> Curve:
    """Mean returns of the evaluations during training, at these steps."""
    begun = np.insert(episodes.steps, 0, 0.0), np.insert(episodes.seconds, 0, 0.0)
    return {
        **_labels(planned, "evaluation"),
        "step": steps,
        "episode": np.searchsorted(episodes.steps, steps, side="right").astype(np.float64),
        "seconds": np.interp(steps, *begun),
        "value": returns,
    }


def training_curve(planned: PlannedRun, episodes: Episodes) -> Curve:
    """Means over blocks of episodes, at most `TRAINING_POINTS` for each run."""
    n = len(episodes.returns)
    block = max(-(-n // TRAINING_POINTS), 1)
    ends = np.minimum(np.arange(block, n + block, block), n)
    starts = np.arange(0, n, block)
    sums = np.add.reduceat(episodes.returns, starts) if n else np.empty(0)
    return {
        **_labels(planned, "training"),
        "step": episodes.steps[ends - 1],
        "episode": ends.astype(np.float64),
        "seconds": episodes.seconds[ends - 1],
        "value": sums / (ends - starts),
    }


def _labels(planned: PlannedRun, kind: str) -> Curve:
    return dict(zip(_LABELS, (*planned.labels, planned.seed, kind), strict=True))


def joined(curves: Sequence[Curve]) -> pd.DataFrame:
    """The curves as one table."""
    tables = [pd.DataFrame(curve) for curve in curves if len(curve["step"])]
    return pd.concat(tables or [pd.DataFrame(columns=list(CURVE_COLUMNS))], ignore_index=True)


# --- the results of runs --------------------------------------------------------------------------

LAST_EPISODES = 100


@dataclass(frozen=True)
class RunResults:
    """The results of one finished run or batch."""

    rows: list[dict[str, Any]]  #: rows of the summary, see `RUN_COLUMNS`
    curves: list[Curve] = field(default_factory=list)  #: its learning curves


@dataclass(frozen=True)
class StudyResults:
    """A study and its runs."""

    study: StudySpec  #: the specification
    root: Path  #: its folder
    summary: pd.DataFrame  #: one row for each finished run, see `RUN_COLUMNS`
    curves: pd.DataFrame  #: learning curves of all runs, see `CURVE_COLUMNS`
    planned: tuple[PlannedRun, ...]  #: all runs of the study, including failed ones
    pulls: Mapping[Labels, PullStatistics] = field(default_factory=dict)  #: on bandits
    left_out: Mapping[Path, str] = field(default_factory=dict)  #: files that cannot be read, by run
    finished: tuple[PlannedRun, ...] = ()  #: the runs in the results
    failures: Mapping[Path, str] = field(default_factory=dict)  #: why runs have just failed


# Further columns, if some environment is partially observable: the optimum of agents that see the
# state, and the input of the policies that reach ``optimum``, "observation" or "memory".
HIDDEN_COLUMNS = ("full_optimum", "measured_by")
# Columns with the same name in ``run.json``, under ``final`` and beside it.
_OF_FINAL = (
    *("success_rate", "exact", "optimum", "optimum_at_least", "optimum_is_proven", "baseline"),
    *("gap", "score", "acts_by", "stochastic_return", "discount", "discounted_return"),
    "discounted_optimum",
)
OF_RUN = ("best_timesteps", "n_timesteps", "seconds", "cpu_seconds", "engine")
# Columns of `StudyResults.summary`, explained in docs/compare.md; returns are undiscounted sums.
RUN_COLUMNS = (
    *("agent", "algo", "environment", "env_id", "seed"),
    *("final", "final_std", "final_length", *_OF_FINAL),
    *("best", "best_timesteps", "area", "training", "last_episodes", "regret", "threshold"),
    *("steps_to_threshold", "steps_to_stay", "episodes_to_threshold", "episodes_to_stay"),
    *("n_timesteps", "n_episodes", "seconds", "cpu_seconds", "engine", "path"),
)


def read_results(study: StudySpec, planned: Sequence[PlannedRun], root: Path) -> StudyResults:
    """Read all finished runs, except runs with files that cannot be read."""
    done, rows, left_out = list[PlannedRun](), list[dict[str, Any]](), dict[Path, str]()
    curves = list[Curve]()
    for run in planned:
        try:
            results = read_run(study, run)
        except (UserError, OSError) as error:
            left_out[run.path] = one_line(error)
            continue
        if results is not None:
            done.append(run)
            rows += results.rows
            curves += results.curves
    is_hidden = any(row.get("full_optimum") is not None for row in rows)
    columns = [*RUN_COLUMNS, *(HIDDEN_COLUMNS if is_hidden else ())]
    return StudyResults(
        study,
        root,
        pd.DataFrame(rows, columns=columns),
        joined(curves),
        tuple(planned),
        read_pulls(done),
        left_out,
        tuple(done),
    )


def read_run(study: StudySpec, planned: PlannedRun) -> RunResults | None:
    """Read the results of a run, or None if it is missing or not finished.

    Raises UserError if a file that a comparison reads is missing or invalid.
    """
    recorded = planned.recorded()
    if not planned.is_finished_by(recorded):
        return None
    try:
        if planned.is_batch:
            rows, curves = _batch_rows(planned, recorded), []
        else:
            episodes = read_episodes(planned.path)
            steps, returns = read_evaluations(planned.path / "evaluations.npz")
            if recorded["final"] and recorded["n_timesteps"] in steps[-1:]:
                returns[-1] = recorded["final"]["mean_return"]  # that one preceded the last update
            evaluations = evaluation_curve(planned, episodes, steps, returns)
            curves = [evaluations, training_curve(planned, episodes)]
            rows = [summary_row(study, planned, recorded, episodes, curves[0])]
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{planned.path / RECORD} is damaged: {error!r}") from error
    spec, path = planned.spec, str(planned.path)
    named = {"agent": planned.agent, "environment": planned.environment, "path": path}
    named |= {"algo": spec.algo, "env_id": spec.env_id}
    return RunResults([named | row for row in rows], curves)


def _batch_rows(planned: PlannedRun, recorded: Mapping[str, Any]) -> list[dict[str, Any]]:
    pulls = PullStatistics.load(planned.path / STATISTICS_FILE)
    shared = {
        "n_timesteps": planned.spec.n_timesteps,
        "n_episodes": 1,
        "seconds": recorded["seconds"] / planned.n_runs,
        "cpu_seconds": recorded["cpu_seconds"] / planned.n_runs,
        "engine": recorded["engine"],
    }
    totals = zip(pulls.total_reward.tolist(), pulls.total_regret.tolist(), strict=True)
    return [
        {**shared, "seed": seed, "training": reward, "last_episodes": reward, "regret": regret}
        for seed, (reward, regret) in enumerate(totals, start=planned.seed)
    ]


def summary_row(
    study: StudySpec,
    planned: PlannedRun,
    recorded: Mapping[str, Any],
    episodes: Episodes,
    evaluations: Curve,
) -> dict[str, Any]:
    """The row of a run in the summary, from its record, episodes and evaluations."""
    final = recorded["final"] or {}
    final = with_memory(final) if planned.on_memory_scale else final
    steps, values = evaluations["step"], evaluations["value"]
    returns = episodes.returns if len(episodes.returns) else np.array([np.nan])
    return {
        "seed": planned.seed,
        "final": final.get("mean_return"),
        "final_std": final.get("std_return"),
        "final_length": final.get("mean_length"),
        **{name: final.get(name) for name in (*_OF_FINAL, *HIDDEN_COLUMNS)},
        "best": recorded["best_mean_return"],
        "area": _area(steps, values),
        "training": float(returns.mean()),
        "last_episodes": float(returns[-LAST_EPISODES:].mean()),
        "regret": run_regret(planned),
        **speed_figures(study, planned.spec.env_id, final, evaluations),
        "n_episodes": len(episodes.returns),
        **{name: recorded[name] for name in OF_RUN},
    }


def _area(steps: Floats, values: Floats) -> float | None:
    """The mean height of a curve: the trapezoidal rule, divided by its span."""
    if not len(steps):
        return None
    span = float(steps[-1] - steps[0])
    return float(np.trapezoid(values, steps)) / span if span else float(values[-1])


def threshold_of(study: StudySpec, env_id: str, final: dict[str, Any]) -> float | None:
    """The return that counts as solved; None if it is not defined."""
    if study.threshold is not None:
        return study.threshold
    # It is unknown whether any policy reaches an upper bound of the optimum.
    reachable = final.get("optimum_at_least", final.get("optimum"))
    if "optimum_at_least" in final or reachable is None:
        registered = gym.spec(env_id).reward_threshold if env_id else None
        if registered is not None:
            return float(registered)
    if reachable is None:
        return None
    baseline = float(final["baseline"])
    return baseline + 0.95 * (float(reachable) - baseline)


def speed_figures(
    study: StudySpec, env_id: str, final: dict[str, Any], evaluations: Curve
) -> dict[str, float | None]:
    """The columns of the summary on the threshold, from the curve of a run's evaluations."""
    threshold = threshold_of(study, env_id, final)
    steps, values, found = evaluations["step"], evaluations["value"], {"threshold": threshold}
    for name, to_stay in (("threshold", False), ("stay", True)):
        step = episode = float("nan")
        if threshold is not None and len(steps):
            step = episode = steps_to_threshold(steps, values, threshold, to_stay=to_stay)
        if np.isfinite(step):
            episode = float(evaluations["episode"][np.searchsorted(steps, step)])
        found |= {f"steps_to_{name}": step, f"episodes_to_{name}": episode}
    return found


# --- agents over their seeds ---------------------------------------------------------------------


def values_over_seeds(results: StudyResults, environment: str, column: str) -> dict[str, Floats]:
    """A column of the summary by agent, shape (n_seeds,); NaN for a missing run."""
    table = results.summary[results.summary["environment"] == environment]
    labels = [agent.label for agent in results.study.agents]
    pivot = table.pivot(index="seed", columns="agent", values=column)
    pivot = pivot.reindex(index=results.study.seeds, columns=labels)
    return {str(agent): pivot[agent].to_numpy(dtype=np.float64, na_value=np.nan) for agent in pivot}


@dataclass(frozen=True, eq=False)
class Tried:
    """A change and its results."""

    change: str  #: as typed, or ``"as it is"``
    returns: Floats  #: of the final policy by seed, NaN for runs that did not finish

    @property
    def finished(self) -> Floats:
        """The returns of the runs that finished."""
        return self.returns[~np.isnan(self.returns)]

    @property
    def mean(self) -> float:
        """The mean return of the runs that finished; -inf without one."""
        return float(self.finished.mean()) if len(self.finished) else -np.inf


def tried(results: StudyResults) -> list[Tried]:
    """The results of an `intervention_study`: as shipped, as it is, then by falling mean return."""
    returns = values_over_seeds(results, results.study.environments[0].label, "final")
    unchanged = (SHIPPED, f"{SHIPPED}, {AS_IT_IS}", AS_IT_IS)
    ranks = {change: rank for rank, change in enumerate(unchanged)}
    found = [Tried(change, values) for change, values in returns.items()]
    return sorted(found, key=lambda one: (ranks.get(one.change, len(ranks)), -one.mean))


def mixed_versions(infos: Iterable[Mapping[str, Any]]) -> str:
    """Versions that differ between the ``run.json`` of runs, in a line; empty if none differ."""
    counts: dict[str, Counter[str]] = {}
    for info in infos:
        for package, version in info.get("versions", {}).items():
            counts.setdefault(package, Counter())[version] += info.get("n_runs", 1)
    mixed = []
    for package, found in counts.items():
        told = [f"{v} ({n} run{'' if n == 1 else 's'})" for v, n in sorted(found.items())]
        mixed += [f"{package} {', '.join(told)}"] if len(told) > 1 else []
    return f"runs were done with different versions: {'; '.join(mixed)}" if mixed else ""
