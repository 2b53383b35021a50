"""Reads the results of a study's finished runs, as tables with one row per observation.

Each file of a run is checked against its digest and its schema. Runs of earlier versions recorded
no digests: only the schema of their files is checked. Functions that read raise `DamagedFileError`
for a file that is missing, changed, or has another schema.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rl_yardstick.experiments.bandits import STATISTICS_FILE, PullStatistics, read_pulls, run_regret
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.study import StudySpec
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.curve_pictures import MEANINGS, read_diagnosis
from rl_yardstick.pipeline.digests import DamagedFileError, read_shaped
from rl_yardstick.pipeline.errors import one_line
from rl_yardstick.pipeline.evaluation.yardstick import with_memory
from rl_yardstick.pipeline.loaded_code import DISTRIBUTIONS
from rl_yardstick.pipeline.runs import Run
from rl_yardstick.pipeline.signs_of_life import Tell, tell_nobody
from rl_yardstick.safe_files.archives import read_members
from rl_yardstick.safe_files.files import UnsafeFileError
from rl_yardstick.verdicts import (
    UNBOUNDED,
    Band,
    Bounds,
    curve_band,
    on_grid,
    shared_grid,
    steps_to_threshold,
)

# --- The files of one run.

LARGEST_FIGURE = 1e300
_FORMER_BASELINE = "best_blind"  # its name in earlier versions
_OPTIONAL = ("cpu_seconds",)  # missing in older versions
_FINAL_FIGURES = (
    "mean_return",
    "std_return",
    "mean_length",
    "success_rate",
    "exact",
    "gap",
    "score",
)
# Missing in runs of earlier versions, and if returns are sampled.
_OTHER_RETURNS = ("stochastic_return", "discount", "discounted_return", "discounted_optimum")
# The last one exists only if the optimum is known only within bounds.
_YARDSTICK = ("optimum", "baseline", "optimum_at_least")
# These exist only for partially observable environments.
_HIDDEN = ("full_optimum", "memory_optimum_at_least", "memory_optimum")
_SCALES = ("observation", "memory")
_MAPS = {
    "timesteps": "n",
    "values": "n states",
    "actions": "n states",
    "optimal_values": "states",
    "optimal_actions": "states choices",
}
_COLUMNS = ["r", "l", "t"]  # return, length, seconds since the beginning


@dataclass(frozen=True)
class Episodes:
    """The training episodes of a run, ordered by their ends."""

    steps: Floats  # steps up to the end, over all environments, shape (n,)
    returns: Floats  # undiscounted returns, shape (n,)
    seconds: Floats  # time since the beginning, shape (n,)


def read_episodes(run: Run) -> Episodes:
    """Read the training episodes in Monitor's files."""
    files = run.files
    paths = files.matching("*.monitor.csv")
    if not paths:
        raise DamagedFileError(run.path / "0.monitor.csv", "is missing")
    tables = [_monitor_table(path, files.read(path)) for path in paths]
    # The environments step together, so all have done the same number of steps.
    steps = np.concatenate([len(paths) * table[:, 1].cumsum() for table in tables])
    order = np.argsort(steps, kind="stable")
    rows = np.concatenate(tables)[order]
    return Episodes(steps[order], rows[:, 0], rows[:, 2])


def _monitor_table(path: Path, content: bytes) -> Floats:
    """Read return, length and time of each episode, shape (n, 3)."""
    try:
        if not content.startswith(b"#"):
            raise ValueError("it does not begin with Monitor's line of settings")
        table = _table_of(content)
    except (ValueError, OverflowError) as error:
        raise DamagedFileError(path, f"is damaged: {one_line(error)}") from error
    if not np.isfinite(table).all() or (table[:, 1] < 1).any():
        raise DamagedFileError(path, "is damaged: an episode has no return, length or time")
    return table


def _table_of(content: bytes) -> Floats:
    """Parse the columns of figures; ignores others, which environments may add."""
    _, names, rows = [*content.split(b"\n", 2), b"", b""][:3]
    found = next(csv.reader([names.decode()]), [])
    places = [found.index(name) for name in _COLUMNS]
    if not rows.strip():
        return np.empty((0, len(places)))
    # NumPy's own reader takes three times as long: half of the total time for reading a run.
    table = pd.read_csv(
        io.BytesIO(rows), header=None, usecols=places, dtype=np.float64, na_filter=False
    )
    return table[places].to_numpy()


def _check_finite(path: Path, *arrays: NDArray[Any]) -> None:
    if not all(np.isfinite(array).all() for array in arrays):
        raise DamagedFileError(path, "is damaged: it holds a number that is not finite")


def read_evaluations(run: Run) -> tuple[Floats, Floats]:
    """Read steps and mean returns of evaluations during training, each (n_evaluations,)."""
    path = run.evaluations_path
    if not run.files.matching(path.name):
        return np.empty(0), np.empty(0)
    arrays = read_shaped(path, run.files.read(path), {"timesteps": "n", "results": "n episodes"})
    steps, returns = arrays["timesteps"], arrays["results"]
    if not returns.size:
        raise DamagedFileError(path, "is damaged: it holds no evaluation")
    _check_finite(path, steps, returns)
    if (steps < 0).any() or (np.diff(steps.astype(np.float64)) < 0).any():
        raise DamagedFileError(path, "is damaged: its steps do not rise")
    return steps.astype(np.float64), returns.mean(axis=1, dtype=np.float64)


def read_outcome(run: Run, required: tuple[str, ...]) -> dict[str, Any]:
    """Read the outcome in ``run.json``, with ``required`` names and ``final`` as a dictionary."""
    info = run.read_info()
    final = info.get("final")
    if not (final is None or isinstance(final, dict)):
        raise DamagedFileError(run.info_path, "is damaged: final holds no figures")
    final = dict(final or {})
    if _FORMER_BASELINE in final:
        final["baseline"] = final.pop(_FORMER_BASELINE)
    missing = [name for name in required if name not in info]
    if missing:
        raise DamagedFileError(run.info_path, f"is damaged: it lacks {missing[0]}")
    given = {name: info[name] for name in (*required, *_OPTIONAL) if name in info}
    given.pop("final", None)
    figures = {name: final[name] for name in (*_FINAL_FIGURES, *_OTHER_RETURNS) if name in final}
    for name, value in (given | figures).items():
        if not (value is None or _is_figure(value)):
            raise DamagedFileError(run.info_path, f"is damaged: {name} is no figure")
    known = tuple(name for name in _YARDSTICK if name in final)
    is_whole = known in ((), _YARDSTICK[:2], _YARDSTICK)
    if not is_whole or not all(_is_figure(final[name]) for name in known):
        raise DamagedFileError(run.info_path, "is damaged: it lacks the optimum's figures")
    hidden = [name for name in _HIDDEN if name in final]
    if hidden and (
        not all(_is_figure(final.get(name)) for name in _HIDDEN)
        or final.get("measured_by") not in _SCALES
        or not known
    ):
        raise DamagedFileError(run.info_path, "is damaged: it lacks figures on what is observed")
    _check_texts(run, info)
    return {**info, "final": final}


def _check_texts(run: Run, info: Mapping[str, Any]) -> None:
    texts = [info.get("engine") or "", info.get("model_refused") or ""]
    texts.append((info.get("final") or {}).get("acts_by") or "")
    for name in ("versions", "machine", DISTRIBUTIONS):
        named = info.get(name, {})
        texts += named.values() if isinstance(named, dict) else [None]
    if not all(isinstance(text, str) for text in texts):
        raise DamagedFileError(run.info_path, "is damaged: engine, versions or machine are no text")


def _is_figure(value: object) -> bool:
    return isinstance(value, int | float) and abs(value) < LARGEST_FIGURE


def read_value_maps(run: Run) -> dict[str, NDArray[Any]]:
    """Read the maps of a run that `pipeline.evaluation.value_maps` wrote."""
    path = run.value_maps_path
    arrays = read_shaped(path, run.files.read(path), _MAPS)
    actions, best_actions = arrays["actions"], arrays["optimal_actions"]
    if not actions.size:
        raise DamagedFileError(path, "is damaged: it holds no evaluation")
    if actions.dtype.kind not in "iu" or best_actions.dtype.kind not in "biu":
        raise DamagedFileError(path, "is damaged: its actions are no whole numbers")
    if (actions < 0).any() or (actions >= best_actions.shape[1]).any():
        raise DamagedFileError(path, "is damaged: it has actions that there are not")
    _check_finite(path, arrays["timesteps"], arrays["values"], arrays["optimal_values"])
    return arrays


def read_compared(run: Run) -> dict[str, Floats]:
    """Read the columns of the diagnosis that `pipeline.evaluation.critics` wrote."""
    path = run.diagnosis_path
    try:
        found = read_diagnosis(run.files.read(path))
        known = {name: found[name] for name in ("timesteps", *MEANINGS) if name in found}
        if not len(known["timesteps"]) or not np.isfinite(known["timesteps"]).all():
            raise ValueError("no steps")
    except (ValueError, KeyError) as error:
        if isinstance(error, DamagedFileError):
            raise
        raise DamagedFileError(path, "is damaged: it is no table of numbers by step") from error
    return known


# --- Learning curves.

TRAINING_POINTS = 100

# Columns of `StudyResults.curves`. Each row is an evaluation, or the mean return of consecutive
# training episodes at the end of the last one.
CURVE_COLUMNS = (
    "agent",
    "environment",
    "seed",
    "kind",  # "evaluation" or "training"
    "step",
    "episode",
    "seconds",
    "value",  # return
)


@dataclass(frozen=True)
class Curve:
    """A learning curve of one run."""

    labels: dict[str, Any]  # the columns of `CURVE_COLUMNS` that are constant in the curve
    figures: dict[str, Floats]  # the other columns, each of shape (n,)


def joined(curves: Sequence[Curve]) -> pd.DataFrame:
    """The curves as one table."""
    if not curves:
        return pd.DataFrame(columns=CURVE_COLUMNS)
    lengths = [len(curve.figures["step"]) for curve in curves]
    columns: dict[str, Any] = {
        name: np.repeat([curve.labels[name] for curve in curves], lengths)
        for name in curves[0].labels
    }
    columns |= {
        name: np.concatenate([curve.figures[name] for curve in curves])
        for name in curves[0].figures
    }
    return pd.DataFrame(columns, columns=list(CURVE_COLUMNS))


def _curve(planned: PlannedRun, kind: str, figures: dict[str, Floats]) -> Curve:
    labels = {"agent": planned.agent, "environment": planned.environment}
    return Curve({**labels, "seed": planned.seed, "kind": kind}, figures)


def evaluation_curve(planned: PlannedRun, episodes: Episodes) -> Curve:
    """Mean returns of the evaluations during training."""
    steps, returns = read_evaluations(planned.run)
    seconds = np.interp(
        steps, np.insert(episodes.steps, 0, 0.0), np.insert(episodes.seconds, 0, 0.0)
    )
    columns = {
        "step": steps,
        "episode": np.searchsorted(episodes.steps, steps, side="right").astype(np.float64),
        "seconds": seconds,
        "value": returns,
    }
    return _curve(planned, "evaluation", columns)


def training_curve(planned: PlannedRun, episodes: Episodes) -> Curve:
    """Means over blocks of episodes, at most `TRAINING_POINTS` for each run."""
    n = len(episodes.returns)
    block = max(-(-n // TRAINING_POINTS), 1)
    ends = np.minimum(np.arange(block, n + block, block), n)
    starts = np.arange(0, n, block)
    sums = np.add.reduceat(episodes.returns, starts) if n else np.empty(0)
    columns = {
        "step": episodes.steps[ends - 1],
        "episode": ends.astype(np.float64),
        "seconds": episodes.seconds[ends - 1],
        "value": sums / (ends - starts),
    }
    return _curve(planned, "training", columns)


# --- The results of runs.

LAST_EPISODES = 100
RUNS_IN_A_PIECE = 1000  # number of runs with curves in memory while tables are written


@dataclass(frozen=True)
class LeftOut:
    """A run that is left out because one of its files is damaged."""

    planned: PlannedRun  #: the run
    reason: str  #: the file and its damage, in one line


@dataclass(frozen=True)
class RunResults:
    """The results of one finished run or batch."""

    rows: list[dict[str, Any]]  #: rows of the summary, see `RUN_COLUMNS`
    curves: list[Curve] = field(default_factory=list)  #: its learning curves


class RunsInFile(Protocol):
    """Stored runs: those of an agent on an environment in a file instead of folders."""

    def __contains__(self, seed: int) -> bool: ...

    def column(self, name: str, study: StudySpec) -> list[Any]:
        """A column of the summary, see `RUN_COLUMNS`."""

    def curves(self, seeds: Sequence[int] | None = None) -> Iterator[list[Curve]]:
        """The evaluation and the training curve of each run with these seeds; by default of all."""

    def infos(self) -> list[dict[str, Any]]:
        """The settings and versions in ``run.json``, once for each group of equal ones."""


@dataclass(frozen=True)
class StudyResults:
    """A study and its runs."""

    study: StudySpec  #: the specification
    root: Path  #: its folder
    summary: pd.DataFrame  #: one row for each finished run, see `RUN_COLUMNS`
    curves: pd.DataFrame  #: learning curves of all runs, see `CURVE_COLUMNS`
    planned: tuple[PlannedRun, ...]  #: all runs of the study, including failed ones
    #: On bandits, figures by pull, by labels of agent and environment.
    pulls: Mapping[tuple[str, str], PullStatistics] = field(default_factory=dict)
    left_out: tuple[LeftOut, ...] = ()  #: the damaged runs
    n_unchecked: int = 0  #: number of runs without digests, whose damage may go unnoticed
    finished: tuple[PlannedRun, ...] = ()  #: the runs in the results
    #: The details of runs that have just failed, by folder.
    failures: Mapping[Path, str] = field(default_factory=dict)
    #: The runs in files instead of folders, by labels; their curves are not in ``curves``.
    stored: Mapping[tuple[str, str], RunsInFile] = field(default_factory=dict)
    kept: tuple[PlannedRun, ...] = ()  #: the stored runs that have folders too, to load agents from

    @property
    def in_folders(self) -> tuple[PlannedRun, ...]:
        """The runs in the results that have folders."""
        if not self.stored:
            return self.finished
        kept = {(*run.labels, run.seed) for run in self.kept}
        return tuple(
            run
            for run in self.finished
            if not self.is_stored(run) or (*run.labels, run.seed) in kept
        )

    def is_stored(self, run: PlannedRun) -> bool:
        """Whether a finished run is in a file instead of a folder."""
        return run.labels in self.stored and run.seed in self.stored[run.labels]

    @property
    def has_curves(self) -> bool:
        """Whether there are learning curves."""
        return bool(self.stored) or not self.curves.empty

    def stored_curves(self) -> Iterator[Curve]:
        """The learning curves of stored runs, in the order of the plan."""
        size = max(RUNS_IN_A_PIECE // max(len(self.stored), 1), 1)
        for start in range(0, self.study.n_seeds if self.stored else 0, size):
            seeds = self.study.seeds[start : start + size]
            found = [run for runs in self.stored.values() for run in runs.curves(seeds)]
            for run in sorted(found, key=lambda run: run[0].labels["seed"]):
                yield from run

    def infos(self) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
        """Agent, environment, settings and versions; once for each group of equal stored runs."""
        told: set[tuple[str, str]] = set()
        for run in self.finished:
            if not self.is_stored(run):
                yield *run.labels, run.run.read_info()
            elif run.labels not in told:
                told.add(run.labels)
                for info in self.stored[run.labels].infos():
                    yield *run.labels, info


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
    "exact",  # whether these are exact expectations, not means of episodes
    "optimum",
    "optimum_at_least",  # lower bound, if ``optimum`` is only an upper bound
    "optimum_is_proven",  # whether this upper bound is proven
    "baseline",
    "gap",  # optimum minus final
    "score",  # final return, scaled: 0 is the best random or constant policy, 1 the optimum
    "acts_by",  # description of the policy in training: "epsilon 0.01", "its own distribution"
    "stochastic_return",  # exact return of this policy
    "discount",  # the agent's discount
    "discounted_return",  # exact return of the final policy under this discount
    "discounted_optimum",  # the optimum under this discount
    "best",  # highest return of an evaluation during training
    "best_timesteps",
    "area",  # mean return over the learning curve
    "training",  # mean return of the training episodes
    "last_episodes",  # mean return of the last 100 training episodes
    "regret",  # on bandits, the sum of best expected rewards minus those of the pulled arms
    "threshold",
    "steps_to_threshold",  # infinite if it was never reached
    "steps_to_stay",  # until the threshold was reached for good
    "episodes_to_threshold",
    "episodes_to_stay",
    "n_timesteps",
    "n_episodes",
    "seconds",
    "cpu_seconds",  # of the run's process; missing in runs of older versions
    "engine",
    "path",
)

# Further columns, if some environment is partially observable: the optimum of agents that see the
# state, and the input of the policies that reach ``optimum``, "observation" or "memory".
HIDDEN_COLUMNS = ("full_optimum", "measured_by")

# Columns with the same name in ``run.json``.
_FIGURES = (
    *("success_rate", "exact", "optimum", "optimum_at_least", "optimum_is_proven", "baseline"),
    *("gap", "score", "acts_by", *_OTHER_RETURNS, *HIDDEN_COLUMNS),
)


def read_results(
    study: StudySpec,
    planned: Sequence[PlannedRun],
    root: Path,
    tell: Tell = tell_nobody,
    read: Callable[[PlannedRun], RunResults | None] | None = None,
    stored: Mapping[tuple[str, str], RunsInFile] | None = None,
) -> StudyResults:
    """Read all finished runs, except runs with damaged files.

    Args:
        study: the study.
        planned: the runs.
        root: the study's folder.
        tell: receives the progress.
        read: a function that reads a run, for example from a cache; by default `read_run`.
        stored: the runs that are in files instead of folders, by labels.
    """
    stored = stored or {}
    rows: dict[int, dict[str, Any]] = {}
    curves, done, left_out, n_rows = [], [], [], 0
    places: dict[tuple[str, str], list[int]] = {labels: [] for labels in stored}
    for place, run in enumerate(planned, start=1):
        tell(f"run {place:,} of {len(planned):,}")
        if run.labels in stored and run.seed in stored[run.labels]:
            places[run.labels].append(n_rows)
            done.append(run)
            n_rows += 1
            continue
        try:
            found = read_run(study, run) if read is None else read(run)
        except DamagedFileError as error:
            left_out.append(LeftOut(run, str(error)))
            continue
        if found is not None:
            rows |= enumerate(found.rows, start=n_rows)
            n_rows += len(found.rows)
            curves += found.curves
            done.append(run)
    apart = [run for run in done if run.labels not in stored or run.seed not in stored[run.labels]]
    return StudyResults(
        study,
        root,
        _summary(
            study, n_rows, rows, {labels: (places[labels], stored[labels]) for labels in stored}
        ),
        joined(curves),
        tuple(planned),
        read_pulls(apart),
        tuple(left_out),
        sum(run.n_runs for run in apart if run.run.files.digests is None),
        tuple(done),
        stored=stored,
    )


def _summary(
    study: StudySpec,
    n_rows: int,
    rows: Mapping[int, dict[str, Any]],
    stored: Mapping[tuple[str, str], tuple[list[int], RunsInFile]],
) -> pd.DataFrame:
    """The summary of ``rows``, by row number, and of stored runs, given with their row numbers."""
    if not stored:
        return pd.DataFrame([*rows.values()], columns=_columns(rows.values()))
    table = {}
    for name in _columns(rows.values()):  # one column at a time, to save memory
        column: list[Any] = [None] * n_rows
        for number, row in rows.items():
            column[number] = row.get(name)
        for numbers, runs in stored.values() if name in RUN_COLUMNS else ():
            for number, value in zip(numbers, runs.column(name, study), strict=True):
                column[number] = value
        table[name] = pd.Series(column)
    return pd.DataFrame(table)


def _columns(rows: Collection[Mapping[str, Any]]) -> list[str]:
    is_hidden = any(row.get("full_optimum") is not None for row in rows)
    return [*RUN_COLUMNS, *(HIDDEN_COLUMNS if is_hidden else ())]


def read_run(study: StudySpec, planned: PlannedRun) -> RunResults | None:
    """Read the results of a run, or None if it is missing or not finished.

    Raises:
        DamagedFileError: if a file that a comparison reads is missing, changed or invalid.
    """
    planned = planned.read()
    planned.check_record()
    if not planned.is_finished:
        return None
    if planned.is_batch:
        return RunResults(_batch_rows(planned))
    _check_for_page(study, planned)
    episodes = read_episodes(planned.run)
    evaluations = evaluation_curve(planned, episodes)
    row = _summary_row(study, planned, episodes, evaluations)
    return RunResults([row], [evaluations, training_curve(planned, episodes)])


def _check_for_page(study: StudySpec, planned: PlannedRun) -> None:
    """Check the files that the page opens later: maps, and the filmed agent."""
    run, files = planned.run, planned.run.files
    for path in files.matching(run.value_maps_path.name):
        files.check(path)
        if files.digests is None:
            read_value_maps(run)
    if files.matching(run.diagnosis_path.name):
        read_compared(run)
    if planned.seed == study.first_seed:
        files.check(run.model_path)
        if not run.model_path.exists():
            raise DamagedFileError(run.model_path, "is missing")


def threshold_of(study: StudySpec, env_id: str, final: dict[str, Any]) -> float | None:
    """The return that counts as solved; None if it is not defined."""
    import gymnasium as gym

    if study.threshold is not None:
        return study.threshold
    # It is unknown whether any policy reaches an upper bound of the optimum.
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


def _batch_rows(planned: PlannedRun) -> list[dict[str, Any]]:
    """Make a row of the summary for each run of a batch."""
    info = read_outcome(planned.run, ("seconds",))
    cpu_seconds = info.get("cpu_seconds")
    path = planned.path / STATISTICS_FILE
    pulls = PullStatistics.load(path)
    if pulls.total_reward.size != planned.n_runs or info["seconds"] is None:
        raise DamagedFileError(path, "is damaged: it is not of as many runs")
    shared = {
        **_named(planned),
        "n_timesteps": planned.spec.hyperparams.n_timesteps,
        "n_episodes": 1,
        "seconds": info["seconds"] / planned.n_runs,
        "cpu_seconds": None if cpu_seconds is None else cpu_seconds / planned.n_runs,
        "engine": info.get("engine"),
    }
    return [
        {**shared, "seed": seed, "training": reward, "last_episodes": reward, "regret": regret}
        for seed, (reward, regret) in enumerate(
            zip(pulls.total_reward.tolist(), pulls.total_regret.tolist(), strict=True),
            start=planned.seed,
        )
    ]


def _summary_row(
    study: StudySpec, planned: PlannedRun, episodes: Episodes, evaluations: Curve
) -> dict[str, Any]:
    info = read_outcome(
        planned.run, ("final", "best_mean_return", "best_timesteps", "n_timesteps", "seconds")
    )
    final = with_memory(info["final"]) if planned.on_memory_scale else info["final"]
    steps, values = evaluations.figures["step"], evaluations.figures["value"]
    return {
        **_named(planned),
        "seed": planned.seed,
        "final": final.get("mean_return"),
        "final_std": final.get("std_return"),
        "final_length": final.get("mean_length"),
        **{name: final.get(name) for name in _FIGURES},
        "best": info["best_mean_return"],
        "best_timesteps": info["best_timesteps"],
        "area": _area(steps, values) if len(steps) else None,
        "training": _mean(episodes.returns),
        "last_episodes": _mean(episodes.returns[-LAST_EPISODES:]),
        "regret": run_regret(planned),
        **speed_figures(study, planned.spec.env_id, final, evaluations.figures),
        "n_timesteps": info["n_timesteps"],
        "n_episodes": len(episodes.returns),
        "seconds": info["seconds"],
        "cpu_seconds": info.get("cpu_seconds"),
        "engine": info.get("engine"),
    }


def _area(steps: Floats, values: Floats) -> float:
    """The mean height of a curve: the trapezoidal rule, divided by its span."""
    span = float(steps[-1] - steps[0])
    return float(np.trapezoid(values, steps)) / span if span else float(values[-1])


def _named(planned: PlannedRun) -> dict[str, Any]:
    """The columns of the summary that identify a run, without its seed."""
    return {
        "agent": planned.agent,
        "algo": planned.spec.algo,
        "environment": planned.environment,
        "env_id": planned.spec.env_id,
        "path": str(planned.path),
    }


def speed_figures(
    study: StudySpec, env_id: str, final: dict[str, Any], evaluations: Mapping[str, Floats]
) -> dict[str, float | None]:
    """The columns of the summary on the threshold, from the curve of a run's evaluations."""
    threshold = threshold_of(study, env_id, final)
    steps, values = evaluations["step"], evaluations["value"]
    reached = stayed = float("nan")
    if threshold is not None and len(steps):
        reached = steps_to_threshold(steps, values, threshold)
        stayed = steps_to_threshold(steps, values, threshold, to_stay=True)

    def episodes_by(step: float) -> float:
        there = np.isfinite(step)
        return float(evaluations["episode"][np.searchsorted(steps, step)]) if there else step

    return {
        "threshold": threshold,
        "steps_to_threshold": reached,
        "steps_to_stay": stayed,
        "episodes_to_threshold": episodes_by(reached),
        "episodes_to_stay": episodes_by(stayed),
    }


# --- Agents over their seeds.

CURVE_POINTS = TRAINING_POINTS  # the most points of a run, and of a curve in a figure


def values_over_seeds(results: StudyResults, environment: str, column: str) -> dict[str, Floats]:
    """A column of the summary by agent, shape (n_seeds,); NaN for a missing run."""
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
    """The learning curves of runs on an environment, by agent and kind."""
    table = results.curves
    table = table[table["environment"] == environment]
    found: dict[tuple[str, str], list[pd.DataFrame]] = {}
    for (agent, kind, _), rows in table.groupby(["agent", "kind", "seed"]):
        found.setdefault((str(agent), str(kind)), []).append(rows)
    return found


def stored_curves(
    results: StudyResults, environment: str, agent: str, kind: str
) -> list[Mapping[str, Floats]]:
    """The learning curves of stored runs, as `curves_by_agent` has those of the others."""
    runs = results.stored.get((agent, environment))
    which = int(kind == "training")
    return [] if runs is None else [run[which].figures for run in runs.curves()]


def mean_curve(
    curves: Sequence[Mapping[str, Any] | pd.DataFrame], by: str, bounds: Bounds = UNBOUNDED
) -> tuple[Floats, Band] | None:
    """The mean learning curve of an agent over its seeds.

    Args:
        curves: the curves of its runs, from `curves_by_agent`.
        by: ``"step"``, ``"episode"`` or ``"seconds"``.
        bounds: the least and the greatest possible return.

    Returns:
        The points, shape (n,), and the means there with intervals; None without runs, or if a run
        ended before the first point of another one.
    """
    runs = [
        (np.asarray(rows[by], dtype=np.float64), np.asarray(rows["value"], dtype=np.float64))
        for rows in curves
    ]
    if not runs or max(points[0] for points, _ in runs) > min(points[-1] for points, _ in runs):
        return None
    grid = shared_grid([points for points, _ in runs], CURVE_POINTS)
    values = np.array([on_grid(points, returns, grid) for points, returns in runs])
    return grid, curve_band(values, bounds)


# --- Comparing two runs.


def difference(run: Run, other: Run) -> str:
    """The difference of two finished runs in words; empty if they are equal to the last bit."""
    if tensors(run) != tensors(other):
        return "the agent"
    one, another = read_episodes(run), read_episodes(other)
    if not (_same(one.steps, another.steps) and _same(one.returns, another.returns)):
        return "the episodes"
    if not all(map(_same, read_evaluations(run), read_evaluations(other))):
        return "the evaluations"
    return ""


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return one.tobytes() == other.tobytes()


def tensors(run: Run) -> dict[str, bytes]:
    """Read the tensors in the zip of the final agent."""
    try:
        members = read_members(run.files.read(run.model_path))
    except UnsafeFileError as error:
        raise DamagedFileError(run.model_path, str(error)) from error
    return {name: content for name, content in members.items() if name.endswith(".pth")}


def mixed_versions(infos: Iterable[Mapping[str, Any]]) -> str:
    """Versions that differ between the ``run.json`` of runs, in a line; empty if none differ."""
    counts: dict[str, Counter[str]] = {}
    for info in infos:
        for package, version in {**info.get(DISTRIBUTIONS, {}), **info.get("versions", {})}.items():
            counts.setdefault(package, Counter())[version] += info.get("n_runs", 1)
    mixed = [
        f"{package} {', '.join(_counted(*item) for item in sorted(found.items()))}"
        for package, found in counts.items()
        if len(found) > 1
    ]
    return f"runs were done with different versions: {'; '.join(mixed)}" if mixed else ""


def _counted(version: str, n_runs: int) -> str:
    return f"{version} ({n_runs} run{'' if n_runs == 1 else 's'})"
