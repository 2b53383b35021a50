"""The tables of a tuning's page: the re-test, what changed, the cost, all trials."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from report.page.markup import setting
from report.tuning_page.tuning_trials import COMPLETE, Trials, kind
from report.wording import number

LEFT_OUT = "-"


@dataclass(frozen=True)
class Change:
    """A setting that the winner has otherwise than what shipped.

    Attributes:
        name: of the setting.
        shipped, found: its values, as a file has them.
    """

    name: str
    shipped: str
    found: str


def changes(trials: Trials, winner: int) -> list[Change]:
    """What a trial has otherwise than the settings that the search began with."""
    settings = {trial["number"]: trial["settings"] or {} for trial in trials.ended}
    before, after = settings.get(0, {}), settings.get(winner, {})
    return [
        Change(name, _said(before, name), _said(after, name))
        for name in dict.fromkeys([*before, *after])
        if _said(before, name) != _said(after, name)
    ]


def _said(settings: Mapping[str, Any], name: str) -> str:
    return setting(settings[name]) if name in settings else LEFT_OUT


def cost(trials: Trials) -> list[tuple[str, str]]:
    """What the search took."""
    record = trials.record
    n_seeds = len(record["seeds"])
    kinds = Counter(kind(trial) for trial in trials.ended)
    whole = len(trials.ended) * n_seeds
    saved = f"{1 - trials.n_runs / whole:.0%}" if whole else LEFT_OUT
    retest = (record["retest"] or {}).get("settings", [])
    return [
        ("Trials", f"{len(trials.ended):,} of {record['n_trials']:,}"),
        *((name[0].upper() + name[1:], f"{count:,}") for name, count in sorted(kinds.items())),
        ("Runs", f"{trials.n_runs:,} of at most {whole:,}"),
        ("Runs saved by ending trials early", saved),
        ("Processor time of all runs", _duration(trials.seconds)),
        ("From the first trial to the end of the last", _duration(trials.wall_seconds)),
        ("Runs of the re-test", f"{sum(each['n_runs'] for each in retest):,}"),
    ]


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return LEFT_OUT
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes, hours = seconds / 60, seconds / 3600
    return f"{minutes:.0f} min" if minutes < 90 else f"{hours:.1f} h"


def rows(trials: Trials) -> list[dict[str, Any]]:
    """All trials, the best first, then those that have not all their seeds."""
    ranked = [*trials.best_first]
    rest = [trial for trial in trials.ended if trial not in ranked]
    return [
        {
            "number": trial["number"],
            "kind": kind(trial),
            "is_whole": kind(trial) == COMPLETE,
            "value": trial["value"] if trial["figures"] else None,
            "n_seeds": len(trial["figures"]),
            "seconds": trial["seconds"],
            "failure": trial["failure"] or "",
            "params": ", ".join(
                f"{name} {_param(value)}" for name, value in trial["params"].items()
            ),
        }
        for trial in [*ranked, *rest]
    ]


def _param(value: Any) -> str:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return number(value) if is_number else setting(value)
