"""What a tuning has come to, as JSON: for its page, and for whoever wants to know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.files import write_json
from tuning.opening import OpenTuning
from tuning.retesting import Outcome
from tuning.trial_queue import FAILURE, FIGURES, SECONDS, SETTINGS

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

FILE = "tuning.json"


def write_record(
    place: OpenTuning, outcome: Outcome | None, command: str, winner_file: str | None
) -> Path:
    """Write what there is; its file.

    Args:
        place: the tuning.
        outcome: of the re-test; None without one.
        command: the command that asked for it.
        winner_file: the file with the winner's settings, None without one.
    """
    tuning, path = place.tuning, place.root / FILE
    data = {
        "name": tuning.study.name,
        "command": command,
        "asked": place.study.user_attrs.get("asked"),
        "figure": tuning.figure,
        "objective": tuning.objective,
        "lower_is_better": tuning.is_cost,
        "n_trials": place.queue.n_trials,
        "seeds": list(tuning.seeds),
        "held_out_seeds": list(tuning.held_out),
        "widened": list(place.suggestions.space.widened),
        "trials": [_trial(trial) for trial in place.queue.trials()],
        "retest": None if outcome is None else _outcome(outcome, winner_file),
    }
    write_json(path, data)
    return path


def _trial(trial: FrozenTrial) -> dict[str, Any]:
    said = trial.user_attrs
    began, ended = trial.datetime_start, trial.datetime_complete
    return {
        "number": trial.number,
        "state": trial.state.name.lower(),
        "value": trial.value,
        "params": dict(trial.params),
        "settings": said.get(SETTINGS),
        "figures": said.get(FIGURES, {}),
        "seconds": said.get(SECONDS, 0.0),
        "failure": said.get(FAILURE),
        "began": None if began is None else began.isoformat(),
        "ended": None if ended is None else ended.isoformat(),
    }


def _outcome(outcome: Outcome, winner_file: str | None) -> dict[str, Any]:
    return {
        "settings": [asdict(each) for each in outcome.retested],
        "winner": None if outcome.winner is None else outcome.winner.label,
        "winner_file": winner_file,
        "reason": outcome.reason,
        "optimism": outcome.optimism,
    }


def n_runs(trials: Sequence[Mapping[str, Any]]) -> int:
    """How many runs trials of a record have judged."""
    return sum(len(trial["figures"]) for trial in trials)
