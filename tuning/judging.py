"""What a run is worth to a search, and what a setting is by its runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.plan import PlannedRun
from experiments.results import read_run
from experiments.run_files import Curve
from pipeline.errors import UserError
from tuning.tuning_spec import Objective, TuningSpec
from verdicts import steps_to_threshold

# What a run costs that never comes to the threshold, in whole runs: with the cost of what was done
# alone, giving up early would look cheap.
WHOLE_RUNS = 2
LOWER = 0.25


class UnjudgedError(Exception):
    """A run is there, and says nothing that a search could go by."""


@dataclass(frozen=True)
class RunOutcome:
    """What came of a run.

    Attributes:
        figure: what it is judged by.
        seconds: processor time that it took.
        name: of the figure: as asked for, but the final return where no score is known.
    """

    figure: float
    seconds: float
    name: str


def outcome_of(tuning: TuningSpec, planned: PlannedRun) -> RunOutcome:
    """What a finished run is judged by, and what it took.

    Raises:
        UnjudgedError: if it has no such figure.
        DamagedFileError: if a file of it is missing or changed.
        UserError: if no run has such a figure here, since nobody says what the threshold is.
    """
    results = read_run(tuning.study, planned)
    if results is None:
        raise UnjudgedError("it has not finished")
    row, name = results.rows[0], tuning.figure
    if name in ("steps", "seconds"):
        figure = _cost(tuning, row, results.curves[0])
    else:
        if name == "score" and row.get(name) is None:  # where no optimum is known
            name = "final"
        figure = _figure(row, name)
    return RunOutcome(figure, float(row.get("cpu_seconds") or row["seconds"]), name)


def _figure(row: Mapping[str, Any], name: str) -> float:
    value = row.get(name)
    if value is None or not math.isfinite(value):
        raise UnjudgedError(f"it has no figure for {name}")
    return float(value)


def _cost(tuning: TuningSpec, row: Mapping[str, Any], evaluations: Curve) -> float:
    """Steps or seconds until the learning curve comes to the threshold.

    Source: a run that never does counts twice, as in the PAR-k of Hutter et al. (2009), "ParamILS",
    JAIR 36.
    """
    threshold, name = row.get("threshold"), tuning.figure
    if threshold is None:
        raise UserError(
            f"--metric {name}: no threshold is known on "
            f"{tuning.environment.env_id}; give --threshold"
        )
    figures = evaluations.figures
    points = figures["step" if name == "steps" else "seconds"]
    reached = steps_to_threshold(points, figures["value"], float(threshold))
    whole = float(row["n_timesteps"] if name == "steps" else row["seconds"])
    return float(reached) if math.isfinite(reached) else WHOLE_RUNS * whole


def judged(figures: Sequence[float], objective: Objective, *, is_cost: bool) -> float:
    """What a setting is worth by its runs.

    Args:
        figures: of its runs, at least one.
        objective: ``mean``; ``iqm``, the mean of the middle half; ``lower``, the quarter below
            which the worst lie.
        is_cost: whether the lower figure is the better; ``lower`` is then the quarter above which
            the worst lie.
    """
    values = np.sort(np.asarray(figures, dtype=np.float64))
    if objective == "mean":
        return float(values.mean())
    if objective == "iqm":
        cut = len(values) // 4
        return float(values[cut : len(values) - cut].mean())
    return float(np.quantile(values, 1 - LOWER if is_cost else LOWER))
