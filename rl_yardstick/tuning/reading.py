"""Reads a trial's settings from an Optuna study of rl_zoo3 or tune, which is only read."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from rl_yardstick.pipeline.errors import UserError, one_line, shown, unknown
from rl_yardstick.pipeline.settings import from_trial

if TYPE_CHECKING:
    from optuna.storages import BaseStorage

SQLITE = "sqlite:///"
SETTINGS = "settings"  # an attribute of tune's trials


def settings_of_trial(
    algo: str, storage: str, study_name: str | None, number: int | None
) -> tuple[dict[str, Any], str, int]:
    """The settings of a trial, the best one by default; its study and its number.

    Args:
        algo: the agent, which decides what some of rl_zoo3's words mean.
        storage: ``sqlite:///FILE``, or the path of Optuna's journal.
        study_name: may be None if there is one study.
        number: of the trial, or None.

    Raises:
        UserError: if there is no such trial, or the file cannot be read.
    """
    if importlib.util.find_spec("optuna") is None:
        raise UserError("--storage needs: pip install 'rl-yardstick[tune]'")
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        opened = _opened(storage)
        names = [study.study_name for study in opened.get_all_studies()]
        name = names[0] if study_name is None and len(names) == 1 else study_name
        if name not in names:
            if name is None:
                held = f"one of {', '.join(names)}" if names else "that of another file"
                raise UserError(f"{storage} has {len(names)} studies: give --study-name, {held}")
            raise unknown(f"{storage} has no study", name, names)
        study = optuna.load_study(study_name=name, storage=opened)
        trials = {trial.number: trial for trial in study.trials}
        if number is not None and number not in trials:
            raise UserError(f"{storage}: {name} has {len(trials)} trials, and no {number}")
        try:
            trial = study.best_trial if number is None else trials[number]
        except (ValueError, RuntimeError) as error:  # none is finished, or it has several values
            raise UserError(f"{storage}: {name} has no best trial: give --trial-id") from error
        own = trial.user_attrs.get(SETTINGS)
        settings = own if isinstance(own, dict) else from_trial(algo, trial.params)
    except UserError:
        raise
    except Exception as error:  # a damaged file, or one of another program, can fail anywhere
        reason = one_line(getattr(error, "orig", error))  # SQLAlchemy adds the statement
        raise UserError(f"--storage: {storage} holds no Optuna study: {reason}") from error
    return settings, name, trial.number


def _opened(storage: str) -> BaseStorage:
    """The storage in a file, opened to read; Optuna would create a file that does not exist."""
    from optuna.storages import JournalStorage, RDBStorage
    from optuna.storages.journal import JournalFileBackend

    place, is_journal = storage.removeprefix(SQLITE), storage.endswith(".log")
    path = Path(place)
    if "://" in place or (place == storage and not is_journal):
        raise UserError(f"--storage is sqlite:///FILE or a journal FILE.log, not {shown(storage)}")
    if not path.is_file():
        raise UserError(f"--storage: {path}: no such file")
    if place == storage:
        return JournalStorage(JournalFileBackend(storage))
    return RDBStorage(f"{SQLITE}file:{quote(str(path.absolute()))}?mode=ro&uri=true")
