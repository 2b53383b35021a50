"""The zip that a path or a run means: the agent at the end, the best, or a checkpoint."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from pipeline.errors import UserError
from pipeline.file_digests import RECORD
from pipeline.models.recorded_runs import run_in
from pipeline.run_folder import INTERRUPTED, Run

Which = Literal["final", "best", "last checkpoint"] | int

# Zips in a run folder or on a model hub that are not the agent at the end of training.
_OTHER_ZIPS = ("best_model.zip", "train_eval_metrics.zip")


def model_at(path: Path, which: Which = "final") -> Path:
    """The zip that a path means.

    Args:
        path: a zip, with or without its suffix, or a run folder.
        which: of a run folder, the agent at the end of training, the best, that of the last
            checkpoint, or that of the checkpoint after so many steps.

    Raises:
        UserError: if there is none, or ``which`` asks for another than the path names.
    """
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
    """The zip of a run.

    Raises:
        UserError: if the run holds none.
    """
    path = _path_in(run, which)
    if not path.exists():
        known = ", ".join(path.stem.split("_")[-2] for path in run.checkpoints())
        reason = "its training may not have ended"
        if run.state == INTERRUPTED:
            reason = "its training was cut off before it was written"
        if isinstance(which, int) and known:
            reason = f"there are checkpoints after {known} steps"
        raise UserError(f"{run.path} holds no {path.name}: {reason}")
    return path


def _path_in(run: Run, which: Which) -> Path:
    if not run.path.is_dir():
        raise UserError(f"{run.path} is no run folder")
    if isinstance(which, int):
        return run.checkpoint_path(which)
    if which == "best":
        return run.best_model_path
    if which == "last checkpoint":
        checkpoints = run.checkpoints()
        if not checkpoints:
            raise UserError(f"{run.path} holds no checkpoint: train with --save-freq")
        return checkpoints[-1]
    return run.model_path if run.env_name else _only_model(run)


def _only_model(run: Run) -> Path:
    """The one zip of a folder that does not name its environment."""
    models = [
        path
        for path in sorted(run.path.glob("*.zip"))
        if path.name not in _OTHER_ZIPS and path not in run.checkpoints()
    ]
    if len(models) != 1:
        held = ", ".join(path.name for path in models) or "no model"
        raise UserError(f"{run.path} is no run folder, and holds {held}: name the zip")
    return models[0]
