"""A search whose runs take no time: what a setting comes to on a seed is a formula."""

from collections import defaultdict
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace

import pytest
from optuna.storages import InMemoryStorage
from rl_yardstick.tuning.trial_storage import TrialQueue, open_storage, open_study

from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.tuning import searching
from rl_yardstick.tuning.search_spaces import read_search_space
from rl_yardstick.tuning.searching import OpenTuning, RunOutcome, Search
from rl_yardstick.tuning.suggesting import Suggestions, make_sampler
from rl_yardstick.tuning.tuning_spec import SHIPPED, TuningSpec

SHIPPED_ENTRY = {"learning_rate": 0.5, "gamma": 0.9, "n_episodes": 10}
SPACE = """\
default:
  learning_rate: {low: 0.01, high: 1.0, scale: log}
  gamma: {low: 0.5, high: 1.0}
"""


def toy_tuning(**changes):
    study = StudySpec(
        name="toy",
        title="toy",
        agents=(AgentSpec(SHIPPED, "qlearning", changes.pop("settings", {})),),
        environments=(EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1"),),
        n_seeds=changes.pop("n_seeds", 3),
    )
    given = {"n_trials": 10, "figure": "score", "n_startup_trials": 4, "pruner": "none"}
    return TuningSpec(study=study, **{**given, **changes})


def opened(storages, tuning, root, storage=None):
    """A driver's view of the toy; those of one folder share a storage in memory, or a real one.

    A storage is named, or given.
    """
    root.mkdir(parents=True, exist_ok=True)
    keeping = storages[root] if storage is None else storage
    keeping = open_storage(root, keeping) if isinstance(keeping, str) else keeping
    path = root / "space.yml"
    path.write_text(SPACE)
    space = read_search_space("qlearning", "FrozenLake-v1", path)
    suggestions = Suggestions(tuning, space, SHIPPED_ENTRY)
    asked = tuning.identity(SHIPPED_ENTRY, {})
    study = open_study(tuning, root, keeping, make_sampler(tuning), asked)
    queue = TrialQueue(study, root, suggestions.n_trials)
    return OpenTuning(tuning, root, study, queue, suggestions)


@dataclass
class ToyRun:
    entry: dict
    seed: int
    is_finished: bool = False


class ToyLauncher:
    """Does runs at once, until it is to break off."""

    def __init__(self, n_workers=1, stops_after=None, failing=()):
        self.n_workers, self.stops_after, self.failing = n_workers, stops_after, failing
        self.done = []

    def submit(self, planned):
        if len(self.done) == self.stops_after:
            raise KeyboardInterrupt
        self.done.append(planned)
        future = Future()
        fails = planned.seed in self.failing
        future.set_result(SimpleNamespace(reason="it broke", log=None) if fails else None)
        return future


class Quiet:
    def run_ended(self):
        pass

    def trial_ended(self, number, value, reason):
        pass


def score(entry, seed):
    return 1.0 - abs(entry["learning_rate"] - 0.1) - abs(entry["gamma"] - 0.95) + 0.01 * seed


def search(
    monkeypatch, place, launcher, figure=score, judged_by="score", steps=lambda *_: None, **options
):
    def outcome_of(_, run):
        value = figure(run.entry, run.seed)
        found = steps(run.entry, run.seed) if value >= 1 else None
        return RunOutcome(value, 1.0, judged_by, found)

    monkeypatch.setattr(searching, "outcome_of", outcome_of)
    with place.queue, suppress(KeyboardInterrupt):
        Search(place, launcher, Quiet(), **options).run()
    return launcher


def states(place):
    return [trial.state.name for trial in place.queue.trials()]


def params(place):
    return [trial.params for trial in place.queue.trials()]


@pytest.fixture
def toy(monkeypatch):
    """All of this, with what does and judges runs replaced."""
    monkeypatch.setattr(searching, "planned_run", lambda _, __, entry, seed: ToyRun(entry, seed))
    return SimpleNamespace(
        tuning=toy_tuning,
        opened=partial(opened, defaultdict(InMemoryStorage)),
        Launcher=ToyLauncher,
        search=partial(search, monkeypatch),
        score=score,
        states=states,
        params=params,
        shipped=SHIPPED_ENTRY,
    )
