"""Stores the trials of a tuning, and shares them between any number of drivers.

An Optuna study has one place for each requested trial. A driver claims a free place, records its
identity there, and gives the place back if it is stopped. A dead driver's place is free again: the
trial continues with the same settings and the seeds that are done. Optuna's own heartbeat would
repeat the settings as a new trial, and journal storage has no heartbeat.
"""

from __future__ import annotations

import contextlib
import json
import math
import secrets
import sqlite3
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import optuna
from optuna import Study, Trial
from optuna.exceptions import ExperimentalWarning, OptunaError, StorageInternalError
from optuna.samplers import BaseSampler
from optuna.storages import BaseStorage, GrpcStorageProxy, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, TrialState, create_trial

from rl_yardstick.pipeline import locks
from rl_yardstick.pipeline.errors import UserError, one_line, shown
from rl_yardstick.pipeline.locks import FolderGoneError, FolderInUseError, folder_lock, is_gone
from rl_yardstick.pipeline.signs_of_life import Heartbeat
from rl_yardstick.tuning.tuning_spec import OWN_FILE, TuningSpec, kind_of, reason_of, without_secret

SECONDS_TO_WAIT = 120  # time-out for other writers of the same SQLite file
SECONDS_TO_CONNECT = 15  # time-out for a proxy
_LONGEST_LINE = 1 << 20  # bytes
_TRIES, _SECONDS_BETWEEN_TRIES = 5, 0.2
_JOURNAL = "journal:"
_ANY_PORT = 13000  # of Optuna's proxy

# Attributes of the study.
ASKED, JUDGED_BY = "asked", "judged by"
# Attributes of a trial, besides Optuna's own data.
DRIVER, FAILURE, FIGURES = "driver", "failure", "figures"
# By each seed with the optimum, the steps to the threshold.
AT_OPTIMUM = "at optimum"
SETTINGS, SECONDS = "settings", "seconds"

SECONDS_BETWEEN_SIGNS = 15.0
SECONDS_OF_SILENCE = 60.0
_SECONDS_BETWEEN_TURNS = 0.02
_MOST_NAMED = 3  # differences from another search, in a message


def open_storage(root: Path, given: str | None) -> BaseStorage:
    """Open the storage of ``--storage``; by default, a SQLite file in the tuning's folder."""
    if given is None:
        return _own_file(root / OWN_FILE)
    try:
        match kind_of(given):
            case "journal":
                return _journal(Path(given.removeprefix(_JOURNAL)))
            case "proxy":
                return _proxy(given)
            case "database":
                return _database(given)
    except ImportError as error:
        lacking = getattr(error.__cause__ or error, "name", None)
        what = f"it needs the package of {lacking}" if lacking else one_line(error)
        raise UserError(f"--storage {without_secret(given)}: {what}: install that") from error


def _own_file(path: Path) -> BaseStorage:
    """Open a SQLite file by path, because in a URL some characters have another meaning."""

    def connect() -> sqlite3.Connection:
        return sqlite3.connect(path, timeout=SECONDS_TO_WAIT, check_same_thread=False)

    return _opened(f"sqlite:///{OWN_FILE}", {"creator": connect}, str(path))


def _journal(path: Path) -> BaseStorage:
    _check_journal(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    backend = JournalFileBackend(str(path), lock_obj=JournalFileOpenLock(str(path)))
    return JournalStorage(backend)


def _check_journal(path: Path) -> None:
    """Refuse a file that is not a journal, or is truncated, before writing to it."""
    if path.is_dir() or not path.name:
        raise UserError(f"--storage journal:FILE: {path} is no file")
    if not path.exists():
        return
    with path.open("rb") as file:
        first = file.readline(_LONGEST_LINE)
    try:
        is_journal = not first or "op_code" in json.loads(first)
    except (ValueError, TypeError, RecursionError):
        is_journal = False
    if not is_journal:
        raise UserError(f"--storage {path}: is there already, and no journal of trials")
    if not any(_ends_whole(path) for _ in range(_TRIES)):
        raise UserError(f"--storage {path}: its last line is cut off: remove that line")


def _ends_whole(path: Path) -> bool:
    """Whether a file ends with a complete line; waits a while for another writer."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - 1, 0))
        is_whole = file.read(1) in (b"", b"\n")
    if not is_whole:
        time.sleep(_SECONDS_BETWEEN_TRIES)
    return is_whole


def _proxy(url: str) -> BaseStorage:
    parts = urlsplit(url)
    if not parts.hostname:
        raise UserError(f"--storage: which machine? {shown(url)} names none: grpc://HOST:PORT")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)  # about the proxy, since 4.2
            proxy = GrpcStorageProxy(host=parts.hostname, port=parts.port or _ANY_PORT)
        proxy.wait_server_ready(SECONDS_TO_CONNECT)
    except (ValueError, OSError) as error:
        raise UserError(f"--storage {url}: there is no proxy: {one_line(error)}") from error
    return proxy


def _database(url: str) -> BaseStorage:
    options = {}
    if url.startswith("sqlite"):
        if url.partition("://")[2].strip("/") in ("", ":memory:"):
            raise UserError(f"--storage {url}: names no file: sqlite:///FILE")
        options = {"connect_args": {"timeout": SECONDS_TO_WAIT}}
    # Optuna replaces braces.
    return _opened(url.replace("{", "{{").replace("}", "}}"), options, without_secret(url))


def _opened(url: str, options: dict[str, Any], name: str) -> BaseStorage:
    from sqlalchemy.exc import SQLAlchemyError

    try:
        return RDBStorage(url, engine_kwargs=options)
    except (SQLAlchemyError, StorageInternalError, RuntimeError, ValueError) as error:
        raise UserError(f"--storage {name}: cannot be opened: {reason_of(error)}") from error


# The study.


def open_study(
    tuning: TuningSpec,
    root: Path,
    storage: BaseStorage,
    sampler: BaseSampler,
    asked: Mapping[str, Any],
) -> Study:
    """Open or create the study of a tuning; refuses another study of the same name.

    ``asked`` is the identity of the tuning as JSON.
    """
    name = tuning.study.name
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with turn(root):
        study = optuna.create_study(
            study_name=name,
            storage=storage,
            sampler=sampler,
            pruner=optuna.pruners.NopPruner(),  # `tuning.pruning` decides
            direction="minimize" if tuning.is_cost else "maximize",
            load_if_exists=True,
        )
        before = study.user_attrs.get(ASKED)
        if before is None:
            study.set_user_attr(ASKED, dict(asked))
        elif before != asked:
            raise UserError(_difference(name, before, asked))
    return study


def _difference(name: str, before: Any, asked: Mapping[str, Any]) -> str:
    there, now = _flat(before), _flat(asked)
    named = [
        # Distributions as JSON are not readable in a message.
        key
        if key.startswith("search_space")
        else f"{key}: {shown(there.get(key))} there, {shown(now.get(key))} now"
        for key in {**there, **now}
        if there.get(key) != now.get(key)
    ]
    words = "; ".join(named[:_MOST_NAMED])
    words += f"; and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
    return f"{name}: the tuning there is another ({words}): --name NAME makes one of its own"


def _flat(asked: object) -> dict[str, Any]:
    """Settings by name, including hyperparameters and parts of the search space."""
    flat: dict[str, Any] = {}
    for key, value in asked.items() if isinstance(asked, Mapping) else ():
        if isinstance(value, Mapping):
            flat |= {f"{key} {inner}": item for inner, item in value.items()}
        else:
            flat[key] = value
    return flat


# The places of a study.


class TrialQueue:
    """A driver's view of the places of a study; ignores places beyond ``n_trials``.

    Drivers that share the folder ``root`` take turns.
    """

    def __init__(self, study: Study, root: Path, n_trials: int) -> None:
        self.study, self.root, self.n_trials = study, root, n_trials
        # The study's own storage, which has a cache.
        self.storage = study._storage
        self._token = secrets.token_hex(8)
        self._n_signs = 0
        self._heard: dict[tuple[int, str], tuple[object, float]] = {}
        self._heart = Heartbeat(self._beat, SECONDS_BETWEEN_SIGNS)

    def add_places(self) -> None:
        """Add missing places, so that the study has one for each trial."""
        with turn(self.root):
            for _ in range(len(self.study.get_trials(deepcopy=False)), self.n_trials):
                self.study.add_trial(create_trial(state=TrialState.WAITING))

    def __enter__(self) -> TrialQueue:
        self.add_places()
        self.free_dead()  # so that a killed driver's trial is continued first
        self.give_sign()
        self._heart.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._heart.stop()

    def trials(self) -> list[FrozenTrial]:
        """The trials of all places, by number."""
        found = self.study.get_trials(deepcopy=False)
        return sorted(found, key=lambda trial: trial.number)[: self.n_trials]

    @property
    def known_figure(self) -> str | None:
        """The figure by which runs of the study are judged; None before the first run."""
        known = self.study.user_attrs.get(JUDGED_BY)
        return None if known is None else str(known)

    def is_done(self) -> bool:
        """Whether every trial has ended."""
        trials = self.trials()
        return len(trials) >= self.n_trials and all(t.state.is_finished() for t in trials)

    def claim(self, params: Callable[[int], Mapping[str, Any]]) -> Trial | None:
        """Claim a free place, if there is one; ``params`` gives fixed parameters by its number."""
        with turn(self.root):  # SQLite would let two drivers claim the same place
            for place in self.trials():
                number = place._trial_id
                if place.state != TrialState.WAITING or not self.storage.set_trial_state_values(
                    number, TrialState.RUNNING
                ):
                    continue
                owner = {**locks.mark(), "token": self._token}
                self.storage.set_trial_user_attr(number, DRIVER, owner)
                if settled := dict(params(place.number)):
                    self.storage.set_trial_system_attr(number, "fixed_params", settled)
                return Trial(self.study, number)
        return None

    def give_back(self, trial: Trial) -> None:
        """Free a trial's place, so that another driver, or this one later, continues the trial."""
        with contextlib.suppress(OptunaError, ValueError), turn(self.root):
            now = self.storage.get_trial(trial._trial_id)
            is_mine = now.user_attrs.get(DRIVER, {}).get("token") == self._token
            if is_mine and now.state == TrialState.RUNNING:
                self.storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)

    def free_dead(self) -> list[int]:
        """Free the places of dead drivers' trials; returns the numbers of these trials."""
        if not any(map(self._is_dead, self.trials())):
            return []
        freed = []
        with turn(self.root):
            for trial in self.trials():  # read again: another driver may have freed them
                if self._is_dead(trial):
                    self.storage.set_trial_state_values(trial._trial_id, TrialState.WAITING)
                    freed.append(trial.number)
        return freed

    def _is_dead(self, trial: FrozenTrial) -> bool:
        """Whether the trial's driver is dead; on another machine, after a time-out."""
        if trial.state != TrialState.RUNNING:
            return False
        owner = trial.user_attrs.get(DRIVER)
        owner = owner if isinstance(owner, Mapping) else {}
        token = str(owner.get("token"))
        if token == self._token:
            return False
        is_alive = locks.is_alive(owner)
        if is_alive is not None:
            return not is_alive
        # A trial without an owner may have just been claimed.
        sign, now = self.study.user_attrs.get(f"driver {token}"), time.monotonic()
        last, since = self._heard.setdefault((trial.number, token), (sign, now))
        if last != sign:
            self._heard[trial.number, token] = (sign, now)
            return False
        return now - since > SECONDS_OF_SILENCE

    def give_sign(self) -> None:
        """Send a heartbeat to drivers on other machines."""
        self._n_signs += 1
        self.study.set_user_attr(f"driver {self._token}", self._n_signs)

    def _beat(self) -> None:
        # After a short failure of the storage, heartbeats must continue.
        with contextlib.suppress(Exception):
            self.give_sign()


@contextlib.contextmanager
def turn(root: Path) -> Iterator[None]:
    """Lock the shared folder for this driver inside the ``with`` statement."""
    with contextlib.ExitStack() as stack:
        while True:
            if is_gone(root):
                raise FolderGoneError(root)
            try:
                # Without messages, because the lock is held only briefly.
                stack.enter_context(folder_lock(root, lambda: None, lambda _: None))
                break
            except (FolderInUseError, FileNotFoundError):  # another driver removed the empty folder
                time.sleep(_SECONDS_BETWEEN_TURNS)
        yield


def figures_of(said: Mapping[str, Any], key: str = FIGURES) -> dict[int, float]:
    """The figures of a trial's seeds; empty if the attribute is invalid."""
    given = said.get(key)
    if not isinstance(given, Mapping):
        return {}
    return {
        int(seed): float(figure)
        for seed, figure in given.items()
        if str(seed).isdecimal() and isinstance(figure, int | float) and math.isfinite(figure)
    }


def seconds_of(said: Mapping[str, Any]) -> float:
    """The total time of a trial's runs; 0 if it is not recorded."""
    given = said.get(SECONDS)
    return float(given) if isinstance(given, int | float) else 0.0
