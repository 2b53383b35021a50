"""A search whose runs take no time: what a setting comes to on a seed is a formula."""

import math
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from optuna.storages import InMemoryStorage

from rl_yardstick.experiments.pool import keep_busy
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.run import Stop
from rl_yardstick.tuning import searching
from rl_yardstick.tuning.searching import RunOutcome, open_search
from rl_yardstick.tuning.suggesting import name_of
from rl_yardstick.tuning.tuning_spec import SHIPPED, TuningSpec

ENTRY = {"n_episodes": 10, "learning_rate": 0.5, "gamma": 0.9}
SPACE = """\
default:
  learning_rate: {low: 0.01, high: 1.0, scale: log}
  gamma: {low: 0.5, high: 1.0}
"""


@dataclass
class ToyRun:
    """A planned run; finished ones are known by their folders."""

    entry: dict
    seed: int
    path: str
    finished: set

    @property
    def is_finished(self):
        return self.path in self.finished

    def recorded(self):
        return {}


class Toy:
    """Searches in a folder; those of one folder share a storage in memory and finished runs."""

    shipped = ENTRY

    def __init__(self, folder, patch):
        self.folder, self.storages, self.finished = folder, {}, {}
        (folder / "space.yml").write_text(SPACE)
        (folder / "entry.yml").write_text(f"FrozenLake-v1: {ENTRY}".replace("'", ""))
        patch.setattr(searching, "planned_runs", self._planned)
        patch.setattr(searching, "outcome_of", lambda _, run: self._outcome(run))
        storage = lambda root: self.storages.setdefault(root, InMemoryStorage())  # noqa: E731
        patch.setattr(searching, "open_storage", storage)

    def tuning(self, **changes):
        settings, path = changes.pop("settings", {}), self.folder / "entry.yml"
        agent = AgentSpec(SHIPPED, "qlearning", settings, conf_file=path)
        place = (EnvironmentSpec("FrozenLake-v1", "FrozenLake-v1"),)
        study = StudySpec("toy", "toy", (agent,), place, n_seeds=changes.pop("n_seeds", 3))
        given = {"n_trials": 10, "figure": "score", "n_startup_trials": 4, "pruner": "none"}
        return TuningSpec(study, **{**given, "search_space": self.folder / "space.yml", **changes})

    def opened(self, tuning=None, name="it"):
        root = self.folder / name
        root.mkdir(exist_ok=True)
        return open_search(tuning or self.tuning(), root)

    def search(self, search, n_workers=1, stops_after=None, failing=lambda run: False, **options):
        """Do the runs, until the process is killed; returns those that were done."""
        done = []
        self.score = options.pop("score", score)
        self.steps = options.pop("steps", lambda *_: None)

        def submit(run, command):
            if len(done) == stops_after:
                raise KeyboardInterrupt
            done.append(run)
            future = Future()
            if failing(run):
                future.set_exception(UserError("it broke"))
            else:
                run.finished.add(run.path)
                future.set_result(None)
            return future

        workers = SimpleNamespace(n_at_once=n_workers, timeout=None, submit=submit, end=len)
        search.deadline = options.pop("deadline", math.inf)
        with suppress(KeyboardInterrupt):
            keep_busy(workers, search.next_run, search.ended, "", Stop())
        return done

    def _planned(self, tuning, root, entry):
        finished = self.finished.setdefault(root, set())
        return [ToyRun(entry, s, f"{name_of(entry)}/{s}", finished) for s in tuning.seeds]

    def _outcome(self, run):
        value, steps = self.score(run.entry, run.seed), self.steps(run.entry, run.seed)
        return RunOutcome(value, 1.0, "score", steps if value >= 1 else None)


def score(entry, seed):
    return 1.0 - abs(entry["learning_rate"] - 0.1) - abs(entry["gamma"] - 0.95) + 0.01 * seed


@pytest.fixture
def toy(tmp_path, monkeypatch):
    return Toy(tmp_path, monkeypatch)
