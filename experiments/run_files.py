"""The files that one finished run left, each held against its digest and its form.

Runs of earlier versions recorded no digests: of these a file counts that has the form. All that
reads here raises `DamagedFileError` for a file that is missing, changed, or holds anything else.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from experiments.plan import PlannedRun
from mdp.array_types import Floats
from pipeline.digests import DamagedFileError, read_arrays
from pipeline.errors import one_line
from pipeline.runs import Run
from safe_files.archives import read_members
from safe_files.files import UnsafeFileError

LARGEST_FIGURE = 1e300
_FORMER_BASELINE = "best_blind"  # what earlier versions called it
_OPTIONAL = ("cpu_seconds",)  # older versions did not measure it
_FINAL_FIGURES = (
    "mean_return",
    "std_return",
    "mean_length",
    "success_rate",
    "exact",
    "gap",
    "score",
)
# The last where the optimum is bracketed.
_YARDSTICK = ("optimum", "baseline", "optimum_at_least")
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
    """The training episodes of a run in the order in which they ended."""

    steps: Floats  # environment steps done by then, over all environments, shape (n,)
    returns: Floats  # undiscounted returns, shape (n,)
    seconds: Floats  # time since the beginning, shape (n,)


def read_episodes(run: Run) -> Episodes:
    """The training episodes that Monitor wrote down."""
    files = run.files
    paths = files.matching("*.monitor.csv")
    if not paths:
        raise DamagedFileError(run.path / "0.monitor.csv", "is missing")
    tables = [_monitor_table(path, files.read(path)) for path in paths]
    # The environments are stepped together: all have done what one of them has.
    steps = np.concatenate([len(paths) * table[:, 1].cumsum() for table in tables])
    order = np.argsort(steps, kind="stable")
    rows = np.concatenate(tables)[order]
    return Episodes(steps[order], rows[:, 0], rows[:, 2])


def _monitor_table(path: Path, content: bytes) -> Floats:
    """Return, length and time of each episode, shape (n, 3)."""
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
    """The columns of the figures; others, which environments may add, are not looked at."""
    _, names, rows = [*content.split(b"\n", 2), b"", b""][:3]
    found = next(csv.reader([names.decode()]), [])
    places = [found.index(name) for name in _COLUMNS]
    if not rows.strip():
        return np.empty((0, len(places)))
    # NumPy's own reader takes three times as long, which is half of what reading a run takes.
    table = pd.read_csv(
        io.BytesIO(rows), header=None, usecols=places, dtype=np.float64, na_filter=False
    )
    return table[places].to_numpy()


def read_shaped(
    run: Run, path: Path, shapes: Mapping[str, str], optional: Collection[str] = ()
) -> dict[str, NDArray[Any]]:
    """The arrays in an archive of a run, by name, each of its shape.

    A shape names the lengths of its axes: those of one name are alike, and one may be a number.
    """
    arrays = read_arrays(path, run.files.read(path))
    lengths: dict[str, int] = {}
    for name, shape in shapes.items():
        if name not in arrays:
            if name in optional:
                continue
            raise DamagedFileError(path, f"is damaged: it lacks {name}")
        axes, found = shape.split(), arrays[name].shape
        wanted = [
            int(axis) if axis.isdigit() else lengths.setdefault(axis, n)
            for axis, n in zip(axes, found, strict=False)
        ]
        if len(axes) != len(found) or tuple(wanted) != found:
            raise DamagedFileError(path, "is damaged: its arrays do not fit each other")
    return arrays


def _check_finite(path: Path, *arrays: NDArray[Any]) -> None:
    if not all(np.isfinite(array).all() for array in arrays):
        raise DamagedFileError(path, "is damaged: it holds what is no finite number")


def read_evaluations(run: Run) -> tuple[Floats, Floats]:
    """Steps and mean returns of the evaluations during training, each of shape (n_evaluations,)."""
    path = run.evaluations_path
    if not run.files.matching(path.name):
        return np.empty(0), np.empty(0)
    arrays = read_shaped(run, path, {"timesteps": "n", "results": "n episodes"})
    steps, returns = arrays["timesteps"], arrays["results"]
    if not returns.size:
        raise DamagedFileError(path, "is damaged: it holds no evaluation")
    _check_finite(path, steps, returns)
    if (steps < 0).any() or (np.diff(steps.astype(np.float64)) < 0).any():
        raise DamagedFileError(path, "is damaged: its steps do not rise")
    return steps.astype(np.float64), returns.mean(axis=1, dtype=np.float64)


def read_outcome(run: Run, required: tuple[str, ...]) -> dict[str, Any]:
    """What ``run.json`` says came out, with ``required`` names; ``final`` maps names to figures."""
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
    figures = {name: final[name] for name in _FINAL_FIGURES if name in final}
    for name, value in (given | figures).items():
        if not (value is None or _is_figure(value)):
            raise DamagedFileError(run.info_path, f"is damaged: {name} is no figure")
    known = tuple(name for name in _YARDSTICK if name in final)
    is_whole = known in ((), _YARDSTICK[:2], _YARDSTICK)
    if not is_whole or not all(_is_figure(final[name]) for name in known):
        raise DamagedFileError(run.info_path, "is damaged: it lacks the optimum's figures")
    _check_texts(run, info)
    return {**info, "final": final}


def _check_texts(run: Run, info: Mapping[str, Any]) -> None:
    texts = [info.get("engine") or "", info.get("model_refused") or ""]
    for name in ("versions", "machine"):
        named = info.get(name, {})
        texts += named.values() if isinstance(named, dict) else [None]
    if not all(isinstance(text, str) for text in texts):
        raise DamagedFileError(run.info_path, "is damaged: engine, versions or machine are no text")


def _is_figure(value: object) -> bool:
    return isinstance(value, int | float) and abs(value) < LARGEST_FIGURE


def read_value_maps(run: Run) -> dict[str, NDArray[Any]]:
    """The maps that a run kept, as `pipeline.evaluation.value_maps` writes them."""
    path = run.value_maps_path
    arrays = read_shaped(run, path, _MAPS)
    actions, best_actions = arrays["actions"], arrays["optimal_actions"]
    if not actions.size:
        raise DamagedFileError(path, "is damaged: it holds no evaluation")
    if actions.dtype.kind not in "iu" or best_actions.dtype.kind not in "biu":
        raise DamagedFileError(path, "is damaged: its actions are no whole numbers")
    if (actions < 0).any() or (actions >= best_actions.shape[1]).any():
        raise DamagedFileError(path, "is damaged: it has actions that there are not")
    _check_finite(path, arrays["timesteps"], arrays["values"], arrays["optimal_values"])
    return arrays


# --- Learning curves.

TRAINING_POINTS = 100

# Columns of `StudyResults.curves`. Each row is an evaluation, or the mean of some episodes of
# training at the end of the last.
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

    labels: dict[str, Any]  # the columns of `CURVE_COLUMNS` that are the same all along
    figures: dict[str, Floats]  # the other columns, each of shape (n,)


def joined(curves: Sequence[Curve]) -> pd.DataFrame:
    """The curves below each other."""
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
    """Means over blocks of episodes, so that no run has more than `TRAINING_POINTS`."""
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


# --- Runs beside each other.


def difference(run: Run, other: Run) -> str:
    """In what two finished runs differ; empty where they are the same to the last bit."""
    if _tensors(run) != _tensors(other):
        return "the agent"
    one, another = read_episodes(run), read_episodes(other)
    if not (_same(one.steps, another.steps) and _same(one.returns, another.returns)):
        return "the episodes"
    if not all(map(_same, read_evaluations(run), read_evaluations(other))):
        return "the evaluations"
    return ""


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return one.tobytes() == other.tobytes()


def _tensors(run: Run) -> dict[str, bytes]:
    """What the agent at the end has learnt, as its zip holds it."""
    try:
        members = read_members(run.files.read(run.model_path))
    except UnsafeFileError as error:
        raise DamagedFileError(run.model_path, str(error)) from error
    return {name: content for name, content in members.items() if name.endswith(".pth")}


def mixed_versions(infos: Iterable[Mapping[str, Any]]) -> str:
    """Which versions differ between the ``run.json`` of runs, in a line; empty where none does."""
    counts: dict[str, Counter[str]] = {}
    for info in infos:
        for package, version in info.get("versions", {}).items():
            counts.setdefault(package, Counter())[version] += info.get("n_runs", 1)
    mixed = [
        f"{package} {', '.join(_counted(*item) for item in sorted(found.items()))}"
        for package, found in counts.items()
        if len(found) > 1
    ]
    return f"runs were done with different versions: {'; '.join(mixed)}" if mixed else ""


def _counted(version: str, n_runs: int) -> str:
    return f"{version} ({n_runs} run{'' if n_runs == 1 else 's'})"
