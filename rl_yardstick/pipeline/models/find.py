"""Finds the files of a model, and reads the agent's settings in their folder.

A folder is a run of this project, a run of rl_zoo3, or a download from a model hub:

| written by | files read |
|---|---|
| this project | ``run.json`` |
| rl_zoo3 | ``<env>/args.yml`` (agent, environment, its arguments) and ``<env>/config.yml`` |
| a model hub | the same two beside the zip |

The first existing source is used. ``env_kwargs`` in ``args.yml`` replace those in ``config.yml``,
as in rl_zoo3, whose ``enjoy`` does not read ``eval_env_kwargs`` either. Reading runs no code from
these files, and imports no module because a file names it.

VecNormalize statistics and replay buffers lie beside the zip, with the names of
Stable-Baselines3's CheckpointCallback, or at their places in rl_zoo3 and on model hubs.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rl_yardstick.pipeline.digests import RECORD, DamagedFileError, read_record
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.runs import INTERRUPTED, Run, environment_name
from rl_yardstick.pipeline.settings.yaml import read_saved_settings
from rl_yardstick.safe_files.files import read_file

_SETTINGS_FILES = ("args.yml", "config.yml")


@dataclass(frozen=True)
class RecordedRun:
    """The settings of an agent, read from its folder."""

    algo: str | None = None  # name of the agent, or None
    env_id: str | None = None  # id of the environment, or None
    # the hyperparameters of its training, or None
    hyperparams: dict[str, Any] | None = None
    # modules that were imported because they register environments
    gym_packages: tuple[str, ...] = ()
    map_name: str = ""  # the file of the environment's map


def run_of(path: Path) -> Run | None:
    """The run folder that contains a model file, or None."""
    # A link to a zip may lie in the run, or point into it.
    folders = (path.parent.resolve(), path.resolve().parent)
    folder = next((one for one in folders if os.path.lexists(one / RECORD)), None)
    if folder is None:
        return None
    env_name = read_record(folder / RECORD).get("env_name")
    if not isinstance(env_name, str):
        return None
    if env_name != environment_name(env_name):
        # ``env_name`` becomes part of file names.
        raise UserError(f"{folder / RECORD} is damaged: env_name is {env_name!r}")
    return Run(folder, env_name)


def run_around(model: Path) -> Run | None:
    """The run folder of a zip, or None; ``env_name`` is empty if settings are beside the zip."""
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
    """The run in a folder; its ``env_name`` is empty if the folder has no settings."""
    run = run_around(folder / "any.zip")
    names = _settings_folders(folder)
    if run is None and len(names) > 1:
        raise UserError(f"{folder} holds models of {', '.join(names)}: name the zip")
    return run or Run(folder, "")


def recorded_run(run: Run | None) -> RecordedRun:
    """Read the settings in a run folder, by the table above; empty if it has none."""
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
            _text(spec.get("map_name")) or "",
        )
    if not _has_settings(run.params_path):
        return RecordedRun()
    paths = [run.params_path / name for name in _SETTINGS_FILES]
    args, config = (read_saved_settings(path) if path.is_file() else {} for path in paths)
    if args.get("env_kwargs") is not None:
        config = {**config, "env_kwargs": args["env_kwargs"]}
    return RecordedRun(
        _text(args.get("algo")), _text(args.get("env")), config, _texts(args.get("gym_packages"))
    )


@contextmanager
def _telling_way_out() -> Iterator[None]:
    """Add advice to the error about a changed file."""
    try:
        yield
    except DamagedFileError as error:
        raise UserError(f"{error}: train again, or name another copy of it") from error


def check_digest(run: Run | None, path: Path) -> None:
    """Check a file against the digest that its run recorded, if any."""
    if run is not None:
        with _telling_way_out():
            run.files.check(path)


def read_recorded(run: Run | None, path: Path, limit: int) -> bytes:
    """Read a whole file of at most ``limit`` bytes; checks the digest of a run's file."""
    if run is None:
        return read_file(path, limit)
    with _telling_way_out():
        return run.files.read(path, limit)


def _has_settings(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _SETTINGS_FILES)


def _settings_folders(folder: Path) -> list[str]:
    """Names of subfolders with a run's settings, which are names of environments."""
    if not folder.is_dir():
        return []
    return sorted(path.name for path in folder.iterdir() if _has_settings(path))


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def _texts(value: object) -> tuple[str, ...]:
    return tuple(item for item in value if isinstance(item, str)) if isinstance(value, list) else ()


_CHECKPOINT = re.compile(r"(.+)_(\d+)_steps")
REPLAY_BUFFER = "replay_buffer.pkl"


def checkpoint_file(model: Path, kind: str) -> Path:
    """The path of a checkpoint's statistics or buffer: ``model_<kind>_<n>_steps.pkl``."""
    checkpoint = _CHECKPOINT.fullmatch(model.stem)
    if checkpoint is None:
        return model.with_name(f"{model.stem}_{kind}.pkl")
    prefix, n_steps = checkpoint.groups()
    return model.with_name(f"{prefix}_{kind}_{n_steps}_steps.pkl")


def statistics_of(model: Path, run: Run | None) -> Path | None:
    """The statistics file of a model: the checkpoint's, its run's last, or a model hub's."""
    settings = [] if run is None else [run.vecnormalize_path]
    beside = [model.with_name(name) for name in ("vec_normalize.pkl", "vecnormalize.pkl")]
    return _first(checkpoint_file(model, "vecnormalize"), *settings, *beside)


def replay_buffer_of(model: Path) -> Path | None:
    """The replay buffer file of a model: the checkpoint's, or else its run's last one."""
    return _first(checkpoint_file(model, "replay_buffer"), model.with_name(REPLAY_BUFFER))


def _first(*paths: Path) -> Path | None:
    return next((path for path in paths if path.is_file()), None)


Which = Literal["final", "best", "last checkpoint"] | int

# Zips in a run folder or on a model hub other than the final agent.
_OTHER_ZIPS = ("best_model.zip", "train_eval_metrics.zip")


def model_at(path: Path, which: Which = "final") -> Path:
    """Find the zip at a path."""
    with_suffix = path.with_name(f"{path.name}.zip") if path.name else path
    if path.is_dir() and (os.path.lexists(path / RECORD) or not with_suffix.is_file()):
        return model_of(run_in(path), which)
    if which != "final":
        raise UserError(
            f"{path} is one model: give its folder for --load-best, --load-checkpoint or "
            "--load-last-checkpoint"
        )
    path = with_suffix if with_suffix.is_file() else path
    if not path.exists():
        raise UserError(f"no such model file: {path}")
    return path


def model_of(run: Run, which: Which = "final") -> Path:
    """Find the zip of a run."""
    if not run.path.is_dir():
        raise UserError(f"{run.path} is no run folder")
    if isinstance(which, int):
        path = run.checkpoint_path(which)
    elif which == "best":
        path = run.best_model_path
    elif which == "last checkpoint":
        checkpoints = run.checkpoints()
        if not checkpoints:
            raise UserError(f"{run.path} holds no checkpoint: train with --save-freq")
        path = checkpoints[-1]
    else:
        path = run.model_path if run.env_name else _only_model(run)
    if not path.exists():
        known = ", ".join(path.stem.split("_")[-2] for path in run.checkpoints())
        reason = "its training may not have ended"
        if run.state == INTERRUPTED:
            reason = "its training was cut off before it was written"
        if isinstance(which, int) and known:
            reason = f"there are checkpoints after {known} steps"
        raise UserError(f"{run.path} holds no {path.name}: {reason}")
    return path


def _only_model(run: Run) -> Path:
    """The only zip of a folder that does not name its environment."""
    models = [
        path
        for path in sorted(run.path.glob("*.zip"))
        if path.name not in _OTHER_ZIPS and path not in run.checkpoints()
    ]
    if len(models) != 1:
        held = ", ".join(path.name for path in models) or "no model"
        raise UserError(f"{run.path} is no run folder, and holds {held}: name the zip")
    return models[0]
