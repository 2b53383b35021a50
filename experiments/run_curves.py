"""Learning curves of single runs, and of all runs of a study as one table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from experiments.planned_runs import PlannedRun
from experiments.run_figures import Episodes, read_evaluations
from mdp.array_types import Floats

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
    """A learning curve of one run.

    Attributes:
        labels: the columns of `CURVE_COLUMNS` that are the same all along.
        figures: the other columns, each of shape (n,).
    """

    labels: dict[str, Any]
    figures: dict[str, Floats]


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
    """Mean returns of the evaluations during training.

    Raises:
        DamagedFileError: if their file is missing or changed, or holds anything else.
    """
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
