"""One run of a study, and whether its folder holds it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.digests import DamagedFileError
from pipeline.files import plain
from pipeline.runs import FINISHED, ReadRun, Run, environment_name
from pipeline.train_spec import TrainSpec, completed

# What a run of the same settings may differ in: where it is written, what is shown meanwhile, and
# where the modules lie that its names come from.
_MAY_DIFFER = (
    "origins",
    "log_folder",
    "tensorboard_log",
    "gym_packages",
    "user_modules",
    "save_every_n_episodes",
    "verbose",
    "progress",
    "log_interval",
    "pictures",
)


@dataclass(frozen=True)
class PlannedRun:
    """One run of a study.

    Attributes:
        agent: label of the agent.
        environment: label of the environment.
        seed: its seed.
        spec: what to train.
        path: its folder, there once it has finished.
        is_batch: whether it stands for all seeds of a bandit agent, of which ``seed`` is the first.
        n_runs: how many runs it stands for.
    """

    agent: str
    environment: str
    seed: int
    spec: TrainSpec
    path: Path
    is_batch: bool = False
    n_runs: int = 1

    @property
    def run(self) -> Run:
        """The run folder."""
        return Run(self.path, environment_name(self.spec.env_id))

    def read(self) -> ReadPlannedRun:
        """The same, for what is asked of its folder from now on: the record is read once."""
        return ReadPlannedRun(**{field.name: getattr(self, field.name) for field in fields(self)})

    @property
    def is_finished(self) -> bool:
        """Whether the folder holds this very run, to its end; what else it holds is not read."""
        try:
            info = self.run.read_info()
        except DamagedFileError:
            return False
        if info.get("state") != FINISHED or info.get("n_runs", 1) != self.n_runs:
            return False
        recorded, wanted = _recorded(info), self.spec.save_every_n_episodes
        return _identity(recorded) == _identity(self.spec.as_data()) and (
            wanted < 1 or self.is_batch or recorded["save_every_n_episodes"] == wanted
        )

    def is_of(self, run: Run) -> bool:
        """Whether what a folder was begun with is this very run."""
        try:
            recorded = _recorded(run.read_info())
        except DamagedFileError:
            return False
        return bool(_identity(recorded) == _identity(self.spec.as_data()))

    @property
    def differences(self) -> dict[str, tuple[Any, Any]]:
        """By name, the settings of a finished run in this folder beside those that are asked for.

        Empty where they are the same: then a run is done again because it lacks something, such as
        checkpoints, or in a batch the seeds that are new.
        """
        try:
            info = self.run.read_info()
        except DamagedFileError:
            return {}
        if info.get("state") != FINISHED:
            return {}
        there = _by_name(_identity(_recorded(info)))
        now = _by_name(_identity(self.spec.as_data()))
        return {
            name: (there.get(name), now.get(name))
            for name in {**there, **now}
            if there.get(name) != now.get(name)
        }

    @property
    def is_to_do(self) -> bool:
        """Whether there is no such run; one that is damaged is there."""
        if self.is_finished:
            return False
        try:
            self.check_record()
        except DamagedFileError:
            return False
        return True

    def check_record(self) -> None:
        """Make sure that the folder, where there is one, says which run it holds.

        Raises:
            DamagedFileError: if its ``run.json`` is missing or damaged.
        """
        path = self.run.info_path
        if not (self.path.is_dir() and any(self.path.iterdir())):
            return
        if not path.exists():
            raise DamagedFileError(path, "is missing")
        if not self.run.recorded_spec():
            raise DamagedFileError(path, "is damaged: it does not say what was asked for")


@dataclass(frozen=True)
class ReadPlannedRun(PlannedRun):
    """One that goes by what its folder said when it was first asked."""

    @cached_property
    def run(self) -> Run:
        """The run folder."""
        return ReadRun(self.path, environment_name(self.spec.env_id))


def _identity(spec: Mapping[str, Any]) -> Any:
    kept = {key: value for key, value in spec.items() if key not in _MAY_DIFFER}
    return plain(kept)


def _recorded(info: Mapping[str, Any]) -> dict[str, Any]:
    spec = info.get("spec")
    return completed(spec if isinstance(spec, dict) else {})


def _by_name(identity: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as they are called, hyperparameters among them."""
    settings = dict(identity)
    hyperparams = settings.pop("hyperparams", None)
    return {**settings, **(hyperparams if isinstance(hyperparams, dict) else {})}
