"""All environments side by side, each as a small figure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from mdp.array_types import Floats
from report.page.sections import Report, Section
from report.series.curve_series import Curve
from report.series.pull_series import PullSeries, mean_regret
from report.series.study_series import EnvironmentSeries

WIDTH, HEIGHT = 200, 100  # in the drawing's own unit


@dataclass(frozen=True)
class SmallFigure:
    """The curves of an environment.

    Attributes:
        name: the environment's.
        what: what goes upwards.
        lines: by agent, corners of its line as SVG takes them.
        optimum: how far from the top the optimum lies; None where it is not known or not shown.
    """

    name: str
    what: str
    lines: Mapping[str, str]
    optimum: float | None


def section(report: Report) -> Section | None:
    """A figure for each environment; None for a single one."""
    environments = report.series.environments
    if len(environments) < 2:
        return None
    figures = [_figure(one) for one in environments]
    agents = [label for label in report.series.marks if any(label in f.lines for f in figures)]
    context = {"figures": figures, "agents": agents, "width": WIDTH, "height": HEIGHT}
    return Section("overview", "Environments", context, data={})


def _figure(one: EnvironmentSeries) -> SmallFigure:
    name = one.environment.environment
    if one.pulls is not None:
        return SmallFigure(name, "cumulative regret by pull", _regret(one.pulls), None)
    evaluations = None if one.curves is None else one.curves["evaluation"]
    curves = {} if evaluations is None else evaluations.by_axis["step"]
    linear = None if evaluations is None else evaluations.linear_up_to
    return _drawn(name, "return of evaluations by step", curves, one.environment.optimum, linear)


def _regret(pulls: PullSeries) -> dict[str, str]:
    curves = {agent: mean_regret(found) for agent, found in pulls.pulls.items()}
    return dict(_drawn("", "", curves, None, None).lines)


def _drawn(
    name: str,
    what: str,
    curves: Mapping[str, Curve],
    optimum: float | None,
    linear: float | None,
) -> SmallFigure:
    upright = {agent: _compressed(curve.y, linear) for agent, curve in curves.items()}
    best = None if optimum is None else float(_compressed(np.array([optimum]), linear)[0])
    known = [*upright.values(), *([] if best is None else [np.array([best])])]
    low, high = _range(known)
    last = max((float(curve.x[-1]) for curve in curves.values()), default=1.0) or 1.0
    lines = {
        agent: " ".join(
            f"{WIDTH * x / last:.1f},{_down(y, low, high):.1f}"
            for x, y in zip(curves[agent].x, values, strict=True)
            if math.isfinite(y)
        )
        for agent, values in upright.items()
    }
    return SmallFigure(name, what, lines, None if best is None else _down(best, low, high))


def _compressed(values: Floats, linear: float | None) -> Floats:
    """Heights on an axis that is logarithmic beyond ``linear``, as the large figure has it."""
    if linear is None:
        return values
    size = np.maximum(np.abs(values) / linear, 1e-300)
    return np.asarray(np.sign(values) * np.where(size <= 1, size, 1 + np.log10(size)))


def _range(values: Iterable[Floats]) -> tuple[float, float]:
    known = np.concatenate([[], *values])
    known = known[np.isfinite(known)]
    return (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)


def _down(value: float, low: float, high: float) -> float:
    """How far below the top, with room for the width of a line."""
    return 4 + (HEIGHT - 8) * (high - value) / ((high - low) or 1.0)
