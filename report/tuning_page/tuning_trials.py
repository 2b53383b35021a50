"""The trials of a tuning, as its record holds them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

COMPLETE, PRUNED, FAILED = "judged on all seeds", "ended early", "failed"


@dataclass(frozen=True)
class Trials:
    """What a tuning has tried.

    Attributes:
        record: what the tuning wrote down, see `tuning.retesting`.
        ended: the trials that have ended, in their order, as they stand there.
    """

    record: Mapping[str, Any]
    ended: tuple[Mapping[str, Any], ...]

    @property
    def is_cost(self) -> bool:
        """Whether the lower figure is the better."""
        return bool(self.record["lower_is_better"])

    @property
    def judged(self) -> list[Mapping[str, Any]]:
        """Those with a figure on one seed at least."""
        return [trial for trial in self.ended if trial["value"] is not None and trial["figures"]]

    @property
    def best_first(self) -> list[Mapping[str, Any]]:
        """Those that have all their seeds, the best first, the earlier where they are equal."""
        whole = [trial for trial in self.judged if kind(trial) == COMPLETE]
        sign = 1 if self.is_cost else -1
        return sorted(whole, key=lambda trial: (sign * trial["value"], trial["number"]))

    @property
    def n_runs(self) -> int:
        """How many runs the search has judged."""
        return sum(len(trial["figures"]) for trial in self.ended)

    @property
    def seconds(self) -> float:
        """What these took, one after the other."""
        return float(sum(trial["seconds"] for trial in self.ended))

    @property
    def wall_seconds(self) -> float | None:
        """From the first trial's beginning to the last one's end; None without any."""
        began = [datetime.fromisoformat(t["began"]) for t in self.ended if t["began"]]
        ended = [datetime.fromisoformat(t["ended"]) for t in self.ended if t["ended"]]
        return (max(ended) - min(began)).total_seconds() if began and ended else None

    def distributions(self) -> dict[str, BaseDistribution]:
        """What each parameter was drawn from."""
        from optuna.distributions import json_to_distribution

        space = (self.record.get("asked") or {}).get("search_space", {})
        return {name: json_to_distribution(text) for name, text in space.items()}


def trials_of(record: Mapping[str, Any]) -> Trials:
    """The trials of a record that have ended."""
    ended = tuple(t for t in record["trials"] if t["state"] in {"complete", "pruned", "fail"})
    return Trials(record, ended)


def kind(trial: Mapping[str, Any]) -> str:
    """How a trial ended."""
    if trial["failure"] or trial["state"] == "fail":
        return FAILED
    return COMPLETE if trial["state"] == "complete" else PRUNED


def importances(trials: Trials) -> dict[str, float]:
    """How much of what makes a trial one of the best tenth each parameter explains.

    Trials that were ended early count too, by the seeds that they had: those that were not are few,
    and good all of them.

    Returns:
        Shares by parameter, which sum to 1, the largest first; empty where trials are too few or
        all alike.

    Source: PED-ANOVA, Watanabe et al. (2023), "PED-ANOVA: Efficiently quantifying hyperparameter
        importance in arbitrary subspaces", IJCAI, as Optuna computes it.
    """
    import optuna

    ranges = trials.distributions()
    judged = trials.judged
    if len({trial["value"] for trial in judged}) < 2 or not ranges:
        return {}
    directions = optuna.study.StudyDirection
    direction = directions.MINIMIZE if trials.is_cost else directions.MAXIMIZE
    study = optuna.create_study(direction=direction, sampler=optuna.samplers.RandomSampler(0))
    for trial in judged:
        params = {name: value for name, value in trial["params"].items() if name in ranges}
        study.add_trial(
            optuna.create_trial(
                value=trial["value"],
                params=params,
                distributions={name: ranges[name] for name in params},
            )
        )
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    with warnings.catch_warnings():
        # Of parameters that few trials have; the page says that few trials say little.
        warnings.filterwarnings("ignore", "Some regimes for parameter")
        found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {name: share for name, share in found.items() if share > 0}
