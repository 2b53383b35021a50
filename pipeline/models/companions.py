"""The files that belong to a model: its normalisation statistics and its replay buffer.

They lie beside the zip under the names that Stable-Baselines3's CheckpointCallback gives them, or
where rl_zoo3 and model hubs have those of the model at the end of training.
"""

from __future__ import annotations

import re
from pathlib import Path

_CHECKPOINT = re.compile(r"(.+)_(\d+)_steps")
_REPLAY_BUFFER = "replay_buffer.pkl"


def statistics_path(model: Path) -> Path:
    """Where the statistics of a model's own moment lie.

    ``best_model_vecnormalize.pkl`` for ``best_model.zip``, ``rl_model_vecnormalize_<n>_steps.pkl``
    for ``rl_model_<n>_steps.zip``.
    """
    return _companion(model, "vecnormalize")


def replay_buffer_path(model: Path) -> Path:
    """Where the replay buffer of a checkpoint's moment lies, named likewise."""
    return _companion(model, "replay_buffer")


def final_replay_buffer_path(folder: Path) -> Path:
    """Where the replay buffer of a run's end lies, as rl_zoo3 has it."""
    return folder / _REPLAY_BUFFER


def statistics_of(model: Path, params_path: Path | None) -> Path | None:
    """The statistics that belong to a model, or None where there are none.

    Args:
        model: the zip.
        params_path: the folder of its run's settings, if it has one.

    Returns:
        The first that there is of: those of its own moment; ``vecnormalize.pkl`` of its run's end;
        ``vec_normalize.pkl`` or ``vecnormalize.pkl`` beside it, as model hubs have them.
    """
    settings = [] if params_path is None else [params_path / "vecnormalize.pkl"]
    beside = [model.with_name(name) for name in ("vec_normalize.pkl", "vecnormalize.pkl")]
    return _first(statistics_path(model), *settings, *beside)


def replay_buffer_of(model: Path) -> Path | None:
    """The replay buffer that belongs to a model: of its own moment, or else its run's last one."""
    return _first(replay_buffer_path(model), model.with_name(_REPLAY_BUFFER))


def _companion(model: Path, kind: str) -> Path:
    checkpoint = _CHECKPOINT.fullmatch(model.stem)
    if checkpoint is None:
        return model.with_name(f"{model.stem}_{kind}.pkl")
    prefix, n_steps = checkpoint.groups()
    return model.with_name(f"{prefix}_{kind}_{n_steps}_steps.pkl")


def _first(*paths: Path) -> Path | None:
    return next((path for path in paths if path.is_file()), None)
