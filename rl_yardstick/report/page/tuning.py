"""The page of a tuning: what was found, how, and what it cost."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from rl_yardstick.pipeline.files import write_text
from rl_yardstick.report.page import frame
from rl_yardstick.report.page.frame import Section, setting
from rl_yardstick.report.words import number

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

COMPLETE, PRUNED, FAILED = "judged on all seeds", "ended early", "failed"


@dataclass(frozen=True)
class Trials:
    """The trials of a tuning."""

    record: Mapping[str, Any]  # the record of the tuning, see `tuning.retesting`

    @cached_property
    def ended(self) -> list[Mapping[str, Any]]:
        """The trials that have ended, in the order of the record."""
        return [t for t in self.record["trials"] if t["state"] in {"complete", "pruned", "fail"}]

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row for each of these, by its number: how it ended, and its value, NaN for none."""
        rows = {t["number"]: (kind(t), t["value"] if t["figures"] else None) for t in self.ended}
        table = pd.DataFrame.from_dict(rows, orient="index", columns=["kind", "value"])
        return table.assign(value=table["value"].astype(float).replace([np.inf, -np.inf], np.nan))

    @property
    def judged(self) -> list[Mapping[str, Any]]:
        """The trials with a figure on at least one seed."""
        return [trial for trial in self.ended if trial["value"] is not None and trial["figures"]]

    @property
    def best_first(self) -> list[Mapping[str, Any]]:
        """The trials judged on all seeds, the best first, and then the others."""
        sign = 1.0 if self.record["lower_is_better"] else -1.0

        def rank(trial: Mapping[str, Any]) -> tuple[float, float]:
            # Those that have the optimum on all seeds go by their steps to it.
            steps = [*trial.get("at_optimum", {}).values()]
            is_optimal = bool(steps) and len(steps) == len(trial["figures"])
            return sum(steps) / len(steps) if is_optimal else math.inf, sign * trial["value"]

        whole = sorted((t for t in self.judged if kind(t) == COMPLETE), key=rank)
        return whole + [trial for trial in self.ended if trial not in whole]

    @cached_property
    def distributions(self) -> dict[str, BaseDistribution]:
        """The distribution of each parameter."""
        from optuna.distributions import json_to_distribution

        space = (self.record["asked"] or {}).get("search_space", {})
        return {name: json_to_distribution(text) for name, text in space.items()}


def kind(trial: Mapping[str, Any]) -> str:
    """How a trial ended."""
    if trial["failure"] or trial["state"] == "fail":
        return FAILED
    return COMPLETE if trial["state"] == "complete" else PRUNED


def importances(trials: Trials) -> dict[str, float]:
    """The importance of each parameter for whether a trial is in the best tenth.

    Trials that ended early count too, by their seeds so far: the others are few, and all good.

    The shares sum to 1, the largest first; empty if trials are too few or all alike.

    Source: PED-ANOVA, Watanabe et al. (2023), "PED-ANOVA: Efficiently quantifying hyperparameter
    importance in arbitrary subspaces", IJCAI, as Optuna computes it.
    """
    import optuna

    ranges = trials.distributions
    judged = trials.judged
    if len({trial["value"] for trial in judged}) < 2 or not ranges:
        return {}
    directions = optuna.study.StudyDirection
    direction = directions.MINIMIZE if trials.record["lower_is_better"] else directions.MAXIMIZE
    study = optuna.create_study(direction=direction, sampler=optuna.samplers.RandomSampler(0))
    for one in judged:
        drawn = {name: ranges[name] for name in one["params"] if name in ranges}
        params = {name: one["params"][name] for name in drawn}
        trial = optuna.create_trial(value=one["value"], params=params, distributions=drawn)
        study.add_trial(trial)
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    with warnings.catch_warnings():
        # The warning is of parameters that few trials have; the page says that itself.
        warnings.filterwarnings("ignore", "Some regimes for parameter")
        found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {name: share for name, share in found.items() if share > 0}


# The share of the worst trials that the axis of values may cut off, to show the best apart.
_BELOW = 0.25


def history(trials: Trials) -> dict[str, Any]:
    """The value of each trial, the best so far, and the value of the shipped settings."""
    table = trials.table
    whole = table["value"].where(table["kind"] == COMPLETE)
    return {
        "isCost": trials.record["lower_is_better"],
        "figure": trials.record["figure"],
        "edge": _edge(trials),
        "shipped": table["value"].get(0),
        "numbers": table.index,
        "best": (whole.cummin() if trials.record["lower_is_better"] else whole.cummax()).ffill(),
        "values": {COMPLETE: whole, PRUNED: table["value"].where(table["kind"] == PRUNED)},
        "texts": [_text(trial) for trial in trials.ended],
        "failed": table.index[table["value"].isna()],
    }


def _text(trial: Mapping[str, Any]) -> str:
    n_seeds = len(trial["figures"])
    value = number(trial["value"] if n_seeds else None)
    return f"trial {trial['number']}: {value} on {n_seeds} seed{'' if n_seeds == 1 else 's'}"


def _edge(trials: Trials) -> float | None:
    """The worst value on the axis of values; None if the axis shows all values.

    It shows the best three quarters of the trials judged on all seeds, or else of all trials. It
    includes the shipped settings unless these would more than double it.
    """
    sign = -1.0 if trials.record["lower_is_better"] else 1.0
    values = sign * trials.table["value"].dropna()
    for some in (values[trials.table["kind"] == COMPLETE], values):
        best, worst = some.max(), some.quantile(_BELOW)
        if best > worst:
            room, shipped = best - worst, best - values.get(0, -math.inf)
            edge = best - 1.15 * (max(room, shipped) if shipped <= 2 * room else room)
            return float(sign * edge) if edge > values.min() else None
    return None


def _said(value: Any) -> str:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return number(value) if is_number else setting(value)


LEFT_OUT = "-"
# The sections by template; importances are left out without data.
SECTIONS = (
    *(("verdict", "Result"), ("history", "History"), ("importances", "Importance")),
    *(("cost", "Cost"), ("trials", "All trials")),
)


def changes(trials: Trials, winner: int) -> list[tuple[str, str, str]]:
    """Names and values of settings that differ between the start of the search and a trial."""
    settings = {trial["number"]: trial["settings"] or {} for trial in trials.ended}
    before, after = settings.get(0, {}), settings.get(winner, {})
    was, now = (
        [setting(values[name]) if name in values else LEFT_OUT for name in {**before, **after}]
        for values in (before, after)
    )
    found = zip({**before, **after}, was, now, strict=True)
    return [change for change in found if change[1] != change[2]]


def cost(trials: Trials) -> list[tuple[str, str]]:
    """The cost of the search."""
    record = trials.record
    kinds = Counter(kind(trial) for trial in trials.ended)
    n_runs = sum(len(trial["figures"]) for trial in trials.ended)
    whole = len(trials.ended) * len(record["seeds"])
    saved = f"{1 - n_runs / whole:.0%}" if whole else LEFT_OUT
    seconds = sum(trial["seconds"] for trial in trials.ended)
    began = [datetime.fromisoformat(t["began"]) for t in trials.ended if t["began"]]
    ended = [datetime.fromisoformat(t["ended"]) for t in trials.ended if t["ended"]]
    wall = (max(ended) - min(began)).total_seconds() if began and ended else None
    retest = (record["retest"] or {}).get("settings", [])
    return [
        ("Trials", f"{len(trials.ended):,} of {record['n_trials']:,}"),
        *((name[0].upper() + name[1:], f"{count:,}") for name, count in sorted(kinds.items())),
        ("Runs", f"{n_runs:,} of at most {whole:,}"),
        ("Runs saved by ending trials early", saved),
        ("Processor time of all runs", _duration(seconds)),
        ("From the first trial to the end of the last", _duration(wall)),
        ("Runs of the re-test", f"{sum(each['n_runs'] for each in retest):,}"),
    ]


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return LEFT_OUT
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def write_tuning_page(
    record: Mapping[str, Any], path: Path, retest_page: str = "", to_train: str = ""
) -> None:
    """Write the page of a tuning: one self-contained file, which needs no network.

    Args:
        record: the record of the tuning, see `tuning.retesting`.
        path: the file, which is replaced.
        retest_page: link from there to the page of the re-test; empty if there is none.
        to_train: the command that trains with the best setting; empty if there is none.
    """
    trials = Trials(record)
    shares = importances(trials)
    asked, retest = record["asked"] or {}, record["retest"]
    retested = {each["label"]: each for each in retest["settings"]} if retest else {}
    winner = retested.get(retest["winner"]) if retest else None
    data: dict[str, Any] = {"page": {"agents": [], "environments": []}}
    data["history"] = history(trials)
    if shares:
        data["importances"] = {"names": [*shares], "shares": [*shares.values()]}
    place = asked.get("env", "an environment")
    place += f" ({record['map_name']})" if record.get("map_name") else ""
    template = frame.templates("tuning").get_template("tuning.html")
    text = template.render(
        title=f"{asked.get('algo', 'an agent')} on {place}",
        record=record,
        asked=asked,
        sections=[Section(*one) for one in SECTIONS if shares or one[0] != "importances"],
        retest=retest,
        retest_page=retest_page,
        winner=winner,
        to_train=to_train,
        changes=[] if winner is None else changes(trials, winner["number"]),
        n_params=len(trials.distributions),
        cost=cost(trials),
        trials=trials.best_first,
        kind=kind,
        said=_said,
        shares=shares,
        data={name: frame.packed(frame.as_json(item)) for name, item in data.items()},
        **frame.page_frame([*frame.SHARED, "tuning/tuning.js", "paper.js"]),
    )
    write_text(path, text)
