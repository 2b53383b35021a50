"""Does runs on bandits as one batch for each agent, and computes figures pull by pull."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.mdp.transition_model import AnyInts, Floats, Ints
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import read_arrays, replacing
from rl_yardstick.pipeline.run import FINISHED, PULLS_FILE, Run
from rl_yardstick.pipeline.spec import TrainSpec

if TYPE_CHECKING:
    from rl_yardstick.agents.bandits.runs import BatchResult

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
FIRST_PULLS = 100  # each is a point; later points are ever farther apart, `MAX_POINTS` in all
MAX_POINTS = 300


@dataclass(frozen=True)
class PullStatistics:
    """Statistics over the runs of one agent on one bandit, and the totals of each run.

    Regret is the best expected reward minus that of the pulled arm. Simple regret is the regret of
    recommending the most pulled arm so far (Bubeck, Munos and Stoltz, 2009), in each context.
    """

    # The points: pulls for which there are statistics, counted from 1.
    pulls: Annotated[Ints, "points"]
    reward: Annotated[Floats, "points"]  # mean reward of a pull since the previous point
    optimal: Annotated[Floats, "points"]  # share of best arms among these pulls
    regret: Annotated[Floats, "points"]  # mean regret of those pulls
    cumulative_regret: Annotated[Floats, "points"]  # mean sum of regrets up to the point
    cumulative_regret_sem: Annotated[Floats, "points"]  # its standard error over runs
    cumulative_regret_quantiles: Annotated[Floats, "5 points"]  # over runs, see `QUANTILES`
    simple_regret: Annotated[Floats, "points"]  # mean over runs
    total_reward: Annotated[Floats, "runs"]
    total_regret: Annotated[Floats, "runs"]
    shares: Annotated[Floats, "contexts arms"]  # share of each arm among the pulls, by context
    # Mean of the final estimates over runs; empty if the agent has no estimates. An agent without
    # contexts has one row for all.
    estimates: Annotated[Floats, "seen arms_seen"]
    estimates_std: Annotated[Floats, "seen arms_seen"]  # their standard deviation over runs
    true_means: Annotated[Floats, "known arms_known"]  # if all runs have the same; else empty
    moments: Annotated[Ints, "moments"]  # pulls after which posteriors were stored
    # Of the first run's arms: parameters of Beta distributions, or means and standard deviations.
    posteriors: Annotated[Floats, "kept contexts_kept arms_kept 2"]

    def save(self, path: Path) -> None:
        """Write all arrays to a NumPy archive."""
        with replacing(path) as beside:
            np.savez(beside, allow_pickle=False, **vars(self))

    @classmethod
    def load(cls, path: Path) -> PullStatistics:
        """Read the file that `save` wrote; UserError if it is missing, or has another schema."""
        kinds = get_type_hints(cls, include_extras=True)
        return cls(**read_arrays(path, {n: kind.__metadata__[0] for n, kind in kinds.items()}))


def points_of(n_pulls: int) -> Ints:
    """The points: all of the first pulls, then pulls at growing distances, shape (points,)."""
    if n_pulls <= MAX_POINTS:
        return np.arange(1, n_pulls + 1)
    first = np.arange(1, FIRST_PULLS + 1)
    rest = np.geomspace(FIRST_PULLS + 1, n_pulls, MAX_POINTS - FIRST_PULLS)
    return np.unique(np.concatenate([first, rest.round().astype(np.int64)]))


def pull_statistics(
    arms: AnyInts,
    rewards: NDArray[np.floating[Any]],
    regrets: Floats,
    contexts: AnyInts | None,
    n_arms: int,
    n_contexts: int = 1,
    estimates: Floats | None = None,
    true_means: Floats | None = None,
    moments: tuple[int, ...] = (),
    posteriors: Floats | None = None,
) -> PullStatistics:
    """Compute the statistics of runs; arrays have a row for each run and a column for each pull.

    Estimates have the shape (n_runs, n_contexts, n_arms), true means (n_contexts, n_arms), and
    posteriors (n_runs, n_moments, n_contexts, n_arms, 2).
    """
    points = points_of(arms.shape[1])
    at = points - 1
    cumulative = np.cumsum(regrets, axis=1)
    cells = arms.astype(np.int64) + n_arms * (0 if contexts is None else contexts.astype(np.int64))
    size = n_arms * n_contexts
    counts = np.bincount(cells.ravel(), minlength=size).reshape(n_contexts, n_arms)
    with np.errstate(invalid="ignore"):
        shares = counts / counts.sum(axis=1, keepdims=True)
    n_runs, empty = len(arms), np.empty((0, 0))
    estimates = empty[None] if estimates is None else estimates
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        # Without nan; nan if no run has a figure.
        mean, std = np.nanmean(estimates, axis=0), np.nanstd(estimates, axis=0)
    return PullStatistics(
        pulls=points,
        reward=_mean_since_last(rewards.mean(axis=0, dtype=np.float64), points),
        optimal=_mean_since_last((regrets == 0.0).mean(axis=0), points),
        regret=_mean_since_last(regrets.mean(axis=0), points),
        cumulative_regret=cumulative[:, at].mean(axis=0),
        cumulative_regret_sem=cumulative[:, at].std(axis=0, ddof=min(1, n_runs - 1)) / n_runs**0.5,
        cumulative_regret_quantiles=np.quantile(cumulative[:, at], QUANTILES, axis=0),
        simple_regret=_simple_regret(cells, regrets, at, (n_contexts, n_arms)),
        total_reward=rewards.sum(axis=1, dtype=np.float64),
        total_regret=cumulative[:, -1],
        shares=shares,
        estimates=mean,
        estimates_std=std,
        true_means=empty if true_means is None else true_means,
        moments=np.array(moments, dtype=np.int64),
        posteriors=np.empty((0, 0, 0, 2)) if posteriors is None else posteriors[0],
    )


def _mean_since_last(by_pull: Floats, points: Ints) -> Floats:
    """Means over the pulls from one point (exclusive) to the next (inclusive)."""
    sums = np.cumsum(by_pull)[points - 1]
    return np.asarray(np.diff(sums, prepend=0.0) / np.diff(points, prepend=0))


def _simple_regret(cells: Ints, regrets: Floats, at: Ints, shape: tuple[int, int]) -> Floats:
    """The mean simple regret over runs, for recommending the most pulled arm so far.

    ``cells`` are combined numbers of context and arm, shape (n_runs, n_pulls); ``at`` are pulls
    counted from 0; ``shape`` has the numbers of contexts and arms.
    """
    n_runs, rows = len(cells), np.arange(len(cells))
    counts = np.zeros((n_runs, shape[0] * shape[1]))
    sums = np.zeros_like(counts)
    result, begin = np.empty(len(at)), 0
    for index, last in enumerate(at.tolist()):
        for pull in range(begin, last + 1):
            counts[rows, cells[:, pull]] += 1
            sums[rows, cells[:, pull]] += regrets[:, pull]
        begin = last + 1
        by_context = counts.reshape(n_runs, *shape)
        most = by_context.argmax(axis=2)[..., None]
        n_most = np.take_along_axis(by_context, most, axis=2)[..., 0]
        regret_of_most = np.take_along_axis(sums.reshape(n_runs, *shape), most, axis=2)[..., 0]
        # Contexts are weighted by how often they were seen.
        weights = by_context.sum(axis=2) / (last + 1)
        result[index] = (weights * regret_of_most / np.maximum(n_most, 1)).sum(axis=1).mean()
    return result


# --- results of batches, and of single runs -------------------------------------------------------

STATISTICS_FILE = "pull_statistics.npz"
_PULLS = ("arms", "rewards", "regrets")  # the arrays of a run, besides contexts


def read_pulls(finished: Sequence[PlannedRun]) -> dict[tuple[str, str], PullStatistics]:
    """Read the figures by pull of all runs on bandits."""
    batches = [run for run in finished if run.is_batch]
    pulls = {run.labels: PullStatistics.load(run.path / STATISTICS_FILE) for run in batches}
    one_by_one: dict[tuple[str, str], list[PlannedRun]] = {}
    for run in finished:
        if (run.path / PULLS_FILE).exists():
            one_by_one.setdefault(run.labels, []).append(run)
    for labels, runs in one_by_one.items():
        pulls[labels] = stacked_statistics(runs[0].spec, [run.path for run in runs])
    return pulls


def run_regret(planned: PlannedRun) -> float | None:
    """The regret of a single run, or None if it was not on a bandit."""
    if not (planned.path / PULLS_FILE).exists():
        return None
    return float(read_run(planned.path, planned.spec.n_timesteps)["regrets"].sum())


def read_run(folder: Path, n_timesteps: int | None) -> dict[str, NDArray[Any]]:
    """Read the pulls of a single run in the order of time, each of shape (n_pulls,).

    Agents that collect whole rollouts exceed ``n_timesteps``; the surplus is dropped.
    """
    shapes = dict.fromkeys((*_PULLS, "contexts"), "environments pulls")
    arrays = read_arrays(folder / PULLS_FILE, shapes, ("contexts",))
    return {name: array.T.ravel()[:n_timesteps] for name, array in arrays.items()}


def stacked_statistics(spec: TrainSpec, folders: list[Path]) -> PullStatistics:
    """The statistics of single runs, from the pulls in their folders."""
    runs = [read_run(folder, spec.n_timesteps) for folder in folders]
    n_pulls = min(len(run["arms"]) for run in runs)
    stacked = {name: np.stack([run[name][:n_pulls] for run in runs]) for name in runs[0]}
    return _statistics_on(spec, *(stacked.get(name) for name in (*_PULLS, "contexts")))


def _statistics_on(
    spec: TrainSpec, arms: Any, rewards: Any, regrets: Any, contexts: Any, **more: Any
) -> PullStatistics:
    """The statistics of pulls on the bandit of a spec, see `pull_statistics`."""
    with closing(make_single_env(spec)) as env:
        bandit: Any = env.unwrapped
        n_arms, n_contexts = bandit.n_arms, max(bandit.n_contexts, 1)
        drifts, means = getattr(bandit, "drift_std", 0.0) > 0, getattr(bandit, "means", None)
        if means is not None and not drifts and not getattr(bandit, "redraws", False):
            more["true_means"] = np.array(means, dtype=np.float64)
        is_known = bandit.n_contexts > 0 and not drifts
    contexts = contexts if n_contexts > 1 else None
    found = pull_statistics(arms, rewards, regrets, contexts, n_arms, n_contexts, **more)
    # Simple regret is not defined if the means drift, or depend on a vector.
    nowhere = np.full_like(found.simple_regret, np.nan)
    return found if is_known else replace(found, simple_regret=nowhere)


# --- all runs of an agent as one batch: each a fresh agent and one episode ------------------------


def do_batch(spec: TrainSpec, n_runs: int, run: Run) -> None:
    """Do ``n_runs`` runs, from the spec's seed on, and save their statistics in the run folder."""
    from rl_yardstick.machine_code import WorkTime
    from rl_yardstick.machine_code.compiling import compile_timer

    started = WorkTime.now()
    with compile_timer() as time_compiling:
        result, engine = _run(spec, n_runs)
    for seed, rewards in enumerate(result.rewards, start=spec.seed):
        if not np.isfinite(rewards).all():
            pull = int(np.argmin(np.isfinite(rewards)))
            raise UserError(f"reward of seed {seed} at step {pull + 1:,} is {rewards[pull]}")
    pulls = result.arms, result.rewards, result.regrets, result.contexts
    more = {name: getattr(result, name) for name in ("estimates", "moments", "posteriors")}
    _statistics_on(spec, *pulls, **more).save(run.path / STATISTICS_FILE)
    taken = WorkTime.now() - started - time_compiling()
    figures = {"n_runs": n_runs, "n_timesteps": len(result.arms[0]), "engine": engine}
    run.record(spec, FINISHED, **figures, **taken.as_data())


def _run(spec: TrainSpec, n_runs: int) -> tuple[BatchResult, str]:
    # Slow imports that only processes with runs need.
    from rl_yardstick.agents import load_algorithm
    from rl_yardstick.agents.bandits.runs import run_batch, run_one_by_one
    from rl_yardstick.agents.compiled.worlds import NotCompilable
    from rl_yardstick.pipeline.components import constructor_arguments

    own = constructor_arguments(spec, load_algorithm(spec.algo), is_dict=False)
    place, seeds = (spec.env_id, spec.env_kwargs), range(spec.seed, spec.seed + n_runs)
    arguments: tuple[Any, ...] = (spec.algo, own, *place, seeds, spec.n_timesteps)
    try:
        return run_batch(*arguments), "compiled batch"
    except NotCompilable as reason:
        return run_one_by_one(*arguments), f"one by one: {reason}"
