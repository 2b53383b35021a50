"""The numbers behind the figures of a tuning's page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from report.tuning_page.tuning_trials import COMPLETE, PRUNED, Trials, kind
from report.wording import number

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

# Trials so far from the best that the others could not be told apart are drawn at the edge.
_SHOWN = 0.8
# Lines of as many strengths as ranks are told apart by.
_GROUPS = 5


def history(trials: Trials) -> dict[str, Any]:
    """Value by trial, the best so far, and what the shipped settings have."""
    best, steps = None, []
    better = min if trials.is_cost else max
    for trial in trials.ended:
        if kind(trial) == COMPLETE and trial["value"] is not None:
            best = trial["value"] if best is None else better(best, trial["value"])
        steps.append(best)
    shipped = next((t["value"] for t in trials.ended if t["number"] == 0), None)
    return {
        "isCost": trials.is_cost,
        "figure": trials.record["figure"],
        "edge": _edge(trials),
        "shipped": shipped,
        "numbers": [trial["number"] for trial in trials.ended],
        "best": steps,
        "values": {
            name: [_value(trial) if kind(trial) == name else None for trial in trials.ended]
            for name in (COMPLETE, PRUNED)
        },
        "texts": [_text(trial) for trial in trials.ended],
        "failed": [t["number"] for t in trials.ended if _value(t) is None],
    }


def _value(trial: Mapping[str, Any]) -> float | None:
    value = trial["value"] if trial["figures"] else None
    return value if value is not None and math.isfinite(value) else None


def _text(trial: Mapping[str, Any]) -> str:
    n_seeds = len(trial["figures"])
    seeds = f"{n_seeds} seed{'' if n_seeds == 1 else 's'}"
    return f"trial {trial['number']}: {number(_value(trial))} on {seeds}"


def _edge(trials: Trials) -> float | None:
    """Where the axis of values ends on the side of the worst; None where all are shown."""
    values = np.array([v for t in trials.ended if (v := _value(t)) is not None])
    if not values.size:
        return None
    sign = -1.0 if trials.is_cost else 1.0
    goods = np.sort(sign * values)
    worst, best = float(goods[0]), float(goods[-1])
    least = float(goods[math.ceil((1 - _SHOWN) * (goods.size - 1))])
    edge = least - 0.15 * (best - least)
    return sign * edge if edge - worst > best - edge else None


def parallel(trials: Trials, shares: Mapping[str, float]) -> dict[str, Any]:
    """Each trial as a line through its parameters, the most important ones first."""
    ranges = trials.distributions()
    names = [*shares, *(name for name in ranges if name not in shares)]
    ranked = sorted(trials.judged, key=lambda t: t["value"], reverse=trials.is_cost)
    return {
        "axes": [{"name": name, "ticks": _ticks(ranges[name])} for name in names],
        "lines": [
            {
                "number": trial["number"],
                "group": min(_GROUPS - 1, rank * _GROUPS // len(ranked)),
                "text": _text(trial),
                "at": [_place(ranges[name], trial["params"].get(name, _ABSENT)) for name in names],
                "said": [_said(trial["params"].get(name, _ABSENT)) for name in names],
            }
            for rank, trial in enumerate(ranked)
        ],
        "groups": _GROUPS,
    }


_ABSENT = object()


def _place(ends: BaseDistribution, value: Any) -> float | None:
    """Where a value lies between the ends, from 0 to 1; None for a parameter that is not there."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if value is _ABSENT:
        return None
    if isinstance(ends, CategoricalDistribution):
        return (ends.choices.index(value) + 0.5) / len(ends.choices)
    assert isinstance(ends, FloatDistribution | IntDistribution)
    low, high, at = float(ends.low), float(ends.high), float(value)
    if ends.log:
        low, high, at = math.log(low), math.log(high), math.log(at)
    return 0.5 if low == high else (at - low) / (high - low)


def _ticks(ends: BaseDistribution) -> list[tuple[float | None, str]]:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(ends, CategoricalDistribution):
        return [(_place(ends, word), _said(word)) for word in ends.choices]
    assert isinstance(ends, FloatDistribution | IntDistribution)
    return [(_place(ends, end), number(end)) for end in (ends.low, ends.high)]


def _said(value: Any) -> str:
    if value is _ABSENT:
        return "not there"
    if value is None:
        return "null"
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return number(value) if is_number else str(value).lower() if value in (True, False) else value
