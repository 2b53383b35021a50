"""What a folder says of the agent in it: a run of ours, one of rl_zoo3, or a model hub's download.

| who wrote it | what is read |
|---|---|
| this project | ``run.json`` |
| rl_zoo3 | ``<env>/args.yml`` (agent, environment, its arguments) and ``<env>/config.yml`` |
| a model hub | the same two beside the zip |

The first that is there counts, and what ``args.yml`` says of ``env_kwargs`` replaces those of
``config.yml``, as in rl_zoo3, whose ``enjoy`` does not read ``eval_env_kwargs`` either. Nothing in
these files is run, and no module is imported because they ask for it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.file_digests import RECORD, DamagedFileError, read_record
from pipeline.run_files import environment_name
from pipeline.run_folder import Run
from pipeline.settings.strict_yaml import read_saved_settings
from safe_files.files import read_file

_SETTINGS_FILES = ("args.yml", "config.yml")


@dataclass(frozen=True)
class RecordedRun:
    """What a folder says of the agent in it.

    Attributes:
        algo: name of the agent, or None.
        env_id: id of the environment, or None.
        hyperparams: the entry of hyperparameters that it was trained with, or None.
        gym_packages: modules that were imported for the environments that they register.
        is_own: whether this project recorded it.
    """

    algo: str | None = None
    env_id: str | None = None
    hyperparams: dict[str, Any] | None = None
    gym_packages: tuple[str, ...] = ()
    is_own: bool = False


def run_of(path: Path) -> Run | None:
    """The run folder that a model file lies in, or None if it lies elsewhere.

    Raises:
        UserError: if the folder's ``run.json`` is damaged.
    """
    # A link to a zip may lie in the run, or lead there.
    folders = (path.parent.resolve(), path.resolve().parent)
    folder = next((one for one in folders if os.path.lexists(one / RECORD)), None)
    if folder is None:
        return None
    env_name = read_record(folder / RECORD).get("env_name")
    if not isinstance(env_name, str):
        return None
    if env_name != environment_name(env_name):
        # Names of files are made of it.
        raise UserError(f"{folder / RECORD} is damaged: env_name is {env_name!r}")
    return Run(folder, env_name)


def run_around(model: Path) -> Run | None:
    """The run folder that a zip lies in, or None where nothing beside it says how it was trained.

    Where the settings lie beside the zip, as model hubs have them, the run's ``env_name`` is empty.
    """
    own = run_of(model)
    if own is not None:
        return own
    folder = model.parent.resolve()
    names = _settings_folders(folder)
    if model.stem in names:
        return Run(folder, model.stem)
    if len(names) == 1:
        return Run(folder, names[0])
    return Run(folder, "") if _has_settings(folder) else None


def run_in(folder: Path) -> Run:
    """The run in a folder; where nothing says how it was trained, its ``env_name`` is empty.

    Raises:
        UserError: if models of several environments lie there.
    """
    run = run_around(folder / "any.zip")
    names = _settings_folders(folder)
    if run is None and len(names) > 1:
        raise UserError(f"{folder} holds models of {', '.join(names)}: name the zip")
    return run or Run(folder, "")


def recorded_run(run: Run | None) -> RecordedRun:
    """What a run folder says, see the table above; of a folder that says nothing, nothing.

    Raises:
        UserError: if a file is damaged, or holds anything but plain data.
    """
    if run is None:
        return RecordedRun()
    spec = run.recorded_spec()
    if spec:
        entry = spec.get("hyperparams")
        return RecordedRun(
            _text(spec.get("algo")),
            _text(spec.get("env_id")),
            entry if isinstance(entry, dict) else None,
            _texts(spec.get("gym_packages")),
            is_own=True,
        )
    if not _has_settings(run.params_path):
        return RecordedRun()
    args, config = _read(run.params_path / "args.yml"), _read(run.params_path / "config.yml")
    if args.get("env_kwargs") is not None:
        config = {**config, "env_kwargs": args["env_kwargs"]}
    return RecordedRun(
        _text(args.get("algo")), _text(args.get("env")), config, _texts(args.get("gym_packages"))
    )


def check_digest(run: Run | None, path: Path) -> None:
    """Make sure that a file of a run is as the run left it, where the run recorded that.

    Raises:
        UserError: if it is not.
    """
    if run is None:
        return
    try:
        run.files.check(path)
    except DamagedFileError as error:
        raise _with_way_out(error) from error


def read_recorded(run: Run | None, path: Path, limit: int) -> bytes:
    """All of a file; where a run recorded what it was, it is as the run left it.

    Args:
        run: the run that the file belongs to, or None.
        path: the file.
        limit: the most bytes that it may have.

    Raises:
        UserError: if it is not so.
        UnsafeFileError: if a file of no run is no regular file, or too large.
        OSError: if such a file cannot be read.
    """
    if run is None:
        return read_file(path, limit)
    try:
        return run.files.read(path, limit)
    except DamagedFileError as error:
        raise _with_way_out(error) from error


def _with_way_out(error: DamagedFileError) -> UserError:
    return UserError(f"{error}: train again, or name another copy of it")


def _read(path: Path) -> dict[str, Any]:
    return read_saved_settings(path) if path.is_file() else {}


def _has_settings(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _SETTINGS_FILES)


def _settings_folders(folder: Path) -> list[str]:
    """Names of the folders inside that hold a run's settings, which are its environments' names."""
    if not folder.is_dir():
        return []
    return sorted(path.name for path in folder.iterdir() if _has_settings(path))


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def _texts(value: object) -> tuple[str, ...]:
    return tuple(item for item in value if isinstance(item, str)) if isinstance(value, list) else ()
