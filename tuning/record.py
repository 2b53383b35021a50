"""What a tuning has come to, as JSON: for its page, and for whoever wants to know."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from pipeline.files import plain, write_json
from tuning.opening import OpenTuning
from tuning.retesting import Outcome
from tuning.trial_queue import FAILURE, SETTINGS, figures_of, seconds_of

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

FILE = "tuning.json"


def write_record(
    place: OpenTuning, outcome: Outcome | None, command: str, winner_file: str | None
) -> dict[str, Any]:
    """Write what there is; and return it.

    Args:
        place: the tuning.
        outcome: of the re-test; None without one.
        command: the command that asked for it.
        winner_file: the file with the winner's settings, None without one.
    """
    tuning = place.tuning
    data: dict[str, Any] = {
        "name": tuning.study.name,
        "command": command,
        "asked": place.study.user_attrs.get("asked"),
        "figure": tuning.figure,
        "objective": tuning.objective,
        "lower_is_better": tuning.is_cost,
        "n_trials": place.queue.n_trials,
        "seeds": list(tuning.seeds),
        "held_out_seeds": list(tuning.held_out),
        "search_engine": tuning.searched(place.suggestions.shipped).get("engine"),
        "engine": place.suggestions.shipped.get("engine"),
        "widened": list(place.suggestions.space.widened),
        "trials": [_trial(trial) for trial in place.queue.trials()],
        "retest": None if outcome is None else _outcome(outcome, winner_file),
    }
    data = plain(data)
    write_json(place.root / FILE, data)
    return data


def _trial(trial: FrozenTrial) -> dict[str, Any]:
    said = trial.user_attrs
    began, ended = trial.datetime_start, trial.datetime_complete
    return {
        "number": trial.number,
        "state": trial.state.name.lower(),
        "value": trial.value,
        "params": dict(trial.params),
        "settings": said.get(SETTINGS),
        "figures": {str(seed): figure for seed, figure in figures_of(said).items()},
        "seconds": seconds_of(said),
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
