"""Trials that drivers take one by one, so that any number of them make one study.

A study has as many places as it was asked for trials. A driver takes a free one, says in it who it
is, and gives it back where it is stopped. A place whose driver is gone is free again: the same
settings are tried on, with the seeds that are done. Optuna's own heartbeat knows no ask-and-tell.
"""

from __future__ import annotations

import contextlib
import math
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline import locks
from pipeline.locks import FolderGoneError, FolderInUseError, folder_lock, is_gone
from pipeline.signs_of_life import Heartbeat

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.trial import FrozenTrial

# What a trial says of itself, besides what Optuna knows.
DRIVER, FAILURE, FIGURES = "driver", "failure", "figures"
SETTINGS, SECONDS = "settings", "seconds"
# What the study says of all of its trials.
JUDGED_BY = "judged by"

SECONDS_BETWEEN_SIGNS = 15.0
SECONDS_OF_SILENCE = 60.0
_SECONDS_BETWEEN_TRIES = 0.02


class TrialQueue:
    """The places of a study, as one driver sees them.

    Args:
        study: the study.
        root: a folder that is there; drivers that share it take turns at the queue.
        n_trials: how many places there are; those beyond are left alone.
    """

    def __init__(self, study: Study, root: Path, n_trials: int) -> None:
        self.study, self.root, self.n_trials = study, root, n_trials
        # The one that the study asks, which remembers what it has read.
        self.storage = study._storage
        self.study_id = self.storage.get_study_id_from_name(study.study_name)
        self.token = secrets.token_hex(8)
        self._n_signs = 0
        self._heard: dict[str, tuple[object, float]] = {}
        self._heart = Heartbeat(self._try_to_give_sign, SECONDS_BETWEEN_SIGNS)

    def __enter__(self) -> TrialQueue:
        self._add_places()
        self._give_sign()
        self._heart.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._heart.stop()

    def trials(self) -> list[FrozenTrial]:
        """All that there is a place for, by number."""
        found = self.storage.get_all_trials(self.study_id, deepcopy=False)
        return sorted(found, key=lambda trial: trial.number)[: self.n_trials]

    def judged_by(self, figure: str) -> str:
        """What runs of the study are judged by: as those before, and the first by ``figure``."""
        known = self.known_figure()
        if known is None:
            self.storage.set_study_user_attr(self.study_id, JUDGED_BY, figure)
        return figure if known is None else known

    def known_figure(self) -> str | None:
        """What runs of the study are judged by; None before the first."""
        known = self.storage.get_study_user_attrs(self.study_id).get(JUDGED_BY)
        return None if known is None else str(known)

    def is_done(self) -> bool:
        """Whether every trial has ended."""
        trials = self.trials()
        return len(trials) >= self.n_trials and all(t.state.is_finished() for t in trials)

    def claim(self, params: Callable[[int], Mapping[str, Any]]) -> Trial | None:
        """Take a free place.

        Args:
            params: the parameters of a trial of this number that are settled beforehand.

        Returns:
            The trial; None where none is free.
        """
        from optuna import Trial
        from optuna.trial import TrialState

        with self._turn():
            for place in self.trials():
                if place.state == TrialState.WAITING and self.storage.set_trial_state_values(
                    place._trial_id, TrialState.RUNNING
                ):
                    self._begin(place, params(place.number))
                    return Trial(self.study, place._trial_id)
        return None

    def _begin(self, place: FrozenTrial, params: Mapping[str, Any]) -> None:
        number = place._trial_id
        owner = {**locks.mark(), "token": self.token}
        self.storage.set_trial_user_attr(number, DRIVER, owner)
        if params:
            self.storage.set_trial_system_attr(number, "fixed_params", dict(params))

    def give_back(self, trial: Trial) -> None:
        """Let another driver, or this one later, go on with a trial."""
        from optuna.exceptions import OptunaError
        from optuna.trial import TrialState

        with contextlib.suppress(OptunaError, ValueError), self._turn():
            if self._is_mine(self.storage.get_trial(trial._trial_id)):
                self.storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)

    def _is_mine(self, trial: FrozenTrial) -> bool:
        from optuna.trial import TrialState

        token = trial.user_attrs.get(DRIVER, {}).get("token")
        return trial.state == TrialState.RUNNING and bool(token == self.token)

    def free_dead(self) -> list[int]:
        """Give back the trials of drivers that are gone; their numbers."""
        from optuna.trial import TrialState

        freed = []
        dead = {t.number for t in self.trials() if self._is_dead(t)}
        if not dead:
            return []
        with self._turn():
            for trial in self.trials():  # as they are now: another may have freed them
                if trial.number in dead and self._is_dead(trial):
                    self.storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)
                    freed.append(trial.number)
        return freed

    def _is_dead(self, trial: FrozenTrial) -> bool:
        """Whether nobody is at work on it: of a driver elsewhere, once it has long been silent."""
        from optuna.trial import TrialState

        if trial.state != TrialState.RUNNING:
            return False
        owner = trial.user_attrs.get(DRIVER)
        owner = owner if isinstance(owner, Mapping) else {}
        token = str(owner.get("token"))
        if token == self.token:
            return False
        is_alive = locks.is_alive(owner)
        if is_alive is not None:
            return not is_alive
        # Without an owner it may have been taken a moment ago.
        sign = (token, self.storage.get_study_user_attrs(self.study_id).get(_sign(token)))
        key, now = f"{trial.number} {token}", time.monotonic()
        before = self._heard.get(key)
        if before is None or before[0] != sign:
            self._heard[key] = (sign, now)
            return False
        return now - before[1] > SECONDS_OF_SILENCE

    def _give_sign(self) -> None:
        self._n_signs += 1
        self.storage.set_study_user_attr(self.study_id, _sign(self.token), self._n_signs)

    def _try_to_give_sign(self) -> None:
        # A storage that is gone for a moment is no reason to fall silent for good.
        with contextlib.suppress(Exception):
            self._give_sign()

    def _add_places(self) -> None:
        from optuna.trial import TrialState, create_trial

        with self._turn():
            there = self.storage.get_n_trials(self.study_id)
            for _ in range(there, self.n_trials):
                self.storage.create_new_trial(
                    self.study_id, template_trial=create_trial(state=TrialState.WAITING)
                )

    @contextlib.contextmanager
    def _turn(self) -> Iterator[None]:
        """Be the only driver at the queue: SQLite lets two of them take the same place."""
        if is_gone(self.root):
            raise FolderGoneError(self.root)
        with turn(self.root):
            yield


@contextlib.contextmanager
def turn(root: Path) -> Iterator[None]:
    """Be the only driver inside the ``with`` statement, of those that share a folder."""
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(folder_lock(root, _nobody, _nobody))
                break
            except (FolderInUseError, FileNotFoundError):  # another removed it, as it was empty
                time.sleep(_SECONDS_BETWEEN_TRIES)
        yield


def figures_of(said: Mapping[str, Any]) -> dict[int, float]:
    """What is known of a trial's seeds; nothing where it is no such thing that stands there."""
    given = said.get(FIGURES)
    if not isinstance(given, Mapping):
        return {}
    return {
        int(seed): float(figure)
        for seed, figure in given.items()
        if str(seed).isdecimal() and isinstance(figure, int | float) and math.isfinite(figure)
    }


def seconds_of(said: Mapping[str, Any]) -> float:
    """What the runs of a trial took together, as far as it is said."""
    given = said.get(SECONDS)
    return float(given) if isinstance(given, int | float) else 0.0


def _nobody(_: str = "") -> None:
    """Of a lock that is held for an instant nothing needs to be told."""


def _sign(token: str) -> str:
    return f"driver {token}"
