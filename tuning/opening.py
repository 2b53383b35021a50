"""A tuning that is ready: everything checked, and what keeps its trials open."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents import ALGORITHMS
from experiments.study_plan import check_settings
from pipeline.errors import UserError
from safe_files.files import take_up
from tuning.judging import judged
from tuning.pruning import is_hopeless
from tuning.samplers import make_sampler
from tuning.search_spaces import read_search_space, steps_aside
from tuning.study_opening import open_study
from tuning.suggesting import Suggestions
from tuning.trial_queue import TrialQueue, figures_of, turn
from tuning.trial_runs import check_entry, shipped_run
from tuning.trial_storage import open_storage
from tuning.tuning_spec import AUTO, TuningSpec

if TYPE_CHECKING:
    from optuna import Study


@dataclass(frozen=True)
class OpenTuning:
    """A tuning, and where it is.

    Attributes:
        tuning: what is asked for.
        root: its folder.
        study: of Optuna.
        queue: its trials.
        suggestions: what they try.
    """

    tuning: TuningSpec
    root: Path
    study: Study
    queue: TrialQueue
    suggestions: Suggestions

    def hopeless(self, number: int, figures: Mapping[int, float]) -> bool:
        """Whether a trial has no more hope to be the best, by its seeds so far."""
        sign = -1.0 if self.tuning.is_cost else 1.0
        others = {
            trial.number: {k: sign * v for k, v in figures_of(trial.user_attrs).items()}
            for trial in self.queue.trials()
            if trial.number != number
        }
        scores = {seed: sign * figure for seed, figure in figures.items()}
        # Costs have their sign turned: of what is left, higher is better.
        value = partial(judged, objective=self.tuning.objective, is_cost=False)
        # A score of 1 is the optimum. Where nobody knows that, returns stand in its place, of which
        # no 1 says anything.
        is_score = self.queue.known_figure() == "score"
        return is_hopeless(
            scores,
            list(others.values()),
            self.tuning.pruner,
            value,
            n_seeds=len(self.tuning.seeds),
            ceiling=1.0 if is_score else -math.inf,
        )


def open_tuning(tuning: TuningSpec, root: Path, storage: str | None) -> OpenTuning:
    """Check what is asked for, and open what keeps its trials.

    Args:
        tuning: what is asked for.
        root: its folder; it is made, where there is nothing to complain of.
        storage: what ``--storage`` says.

    Raises:
        UserError: if it cannot be done so, or is not what was begun under this name.
        UnsafeFileError: if anything but files and folders lies in the folder.
    """
    take_up(root)
    run = shipped_run(tuning, root)
    check_settings(tuning.study, [run])
    if tuning.figure == AUTO:
        is_bandit = ALGORITHMS[tuning.agent.algo].for_bandits
        tuning = replace(tuning, figure="regret" if is_bandit else "score")
    agent = tuning.agent
    space = read_search_space(agent.algo, tuning.environment.env_id, tuning.search_space)
    suggestions = Suggestions(tuning, space, run.spec.saved_hyperparams)
    if not suggestions.n_free:
        raise UserError(f"{agent.algo}: its search space leaves nothing to choose")
    for settings in steps_aside(suggestions.space, suggestions.first):
        check_entry(tuning, root, suggestions.merged(settings))
    n_trials = suggestions.n_trials
    asked = tuning.identity(suggestions.shipped, _as_json(suggestions))
    with _made(root):
        with turn(root):  # of several that make a file's tables at once, all but one would fail
            opened = open_storage(root, storage)
        sampler = make_sampler(tuning)
        study = open_study(tuning.study.name, root, opened, sampler, asked, is_cost=tuning.is_cost)
    return OpenTuning(tuning, root, study, TrialQueue(study, root, n_trials), suggestions)


@contextlib.contextmanager
def _made(root: Path) -> Iterator[None]:
    """A folder that is there, and gone again where something fails and nothing came into it."""
    root.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for folder in (root, *list(root.parents)[:2]):
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def _as_json(suggestions: Suggestions) -> dict[str, Any]:
    from optuna.distributions import distribution_to_json

    return {
        name: distribution_to_json(kind) for name, kind in suggestions.space.distributions().items()
    }
