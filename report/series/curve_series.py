"""Learning curves of all agents, by step, episode and wall time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.analysis import EnvironmentAnalysis
from experiments.results import StudyResults, curves_by_agent, mean_curve
from mdp.array_types import Floats

KINDS = ("evaluation", "training")
AXES = ("step", "episode", "seconds")

# Returns that are so many times larger than what matters flatten a linear axis.
DWARFED = 10


@dataclass(frozen=True)
class Curve:
    """A line and its interval, each of shape (n_points,); NaN where there is no interval."""

    x: Floats
    y: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class LearningCurves:
    """The mean curves on an environment.

    Attributes:
        by_axis: by axis, and then by agent, the best first; an agent without a curve is left out.
        linear_up_to: where a symmetric logarithmic axis of returns ceases to be linear; None for a
            linear axis.
        on_variant: agents whose returns are of a variant of the environment, so that they are not
            to be held against the optimum.
    """

    by_axis: Mapping[str, Mapping[str, Curve]]
    linear_up_to: float | None
    on_variant: tuple[str, ...] = ()


def learning_curves(
    results: StudyResults, environment: EnvironmentAnalysis
) -> dict[str, LearningCurves]:
    """The curves on an environment, by kind."""
    found = {}
    runs = curves_by_agent(results, environment.environment)
    for kind in KINDS:
        of_agents = {agent.agent: runs.get((agent.agent, kind), []) for agent in environment.agents}
        by_axis = {by: _curves(of_agents, by) for by in AXES}
        by_step = [curve.y for curve in by_axis["step"].values()]
        variants = [agent.agent for agent in environment.agents if agent.on_variant]
        found[kind] = LearningCurves(
            by_axis,
            linear_up_to(by_step, environment.optimum),
            tuple(variants) if kind == "training" else (),
        )
    return found


def _curves(of_agents: Mapping[str, Sequence[pd.DataFrame]], by: str) -> dict[str, Curve]:
    curves = {}
    for agent, runs in of_agents.items():
        try:
            found = mean_curve(runs, by)
        except ValueError:
            continue  # a clock that was set back has made wall times fall
        if found is not None:
            points, band = found
            curves[agent] = Curve(points, band.point, band.low, band.high)
    return curves


def linear_up_to(curves: Iterable[Floats], optimum: float | None) -> float | None:
    """Where a symmetric logarithmic axis ceases to be linear.

    Args:
        curves: returns in the order of time, each of shape (n_points,).
        optimum: the highest expected return, where it is known.

    Returns:
        The optimum's magnitude or, where it is not known, the largest of the returns that the
        curves end with; None where no return dwarfs it, so that a linear axis shows all.
    """
    known = [finite for curve in curves if len(finite := curve[np.isfinite(curve)])]
    if not known:
        return None
    if optimum is None:
        optimum = max(float(np.abs(curve[-max(len(curve) // 4, 1) :]).max()) for curve in known)
    scale = max(abs(optimum), 1.0)
    return scale if max(float(np.abs(curve).max()) for curve in known) > DWARFED * scale else None
