"""Running statistics of VecNormalize: read from a file, and put to use."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import UserError, one_line
from pipeline.models.recorded_runs import read_recorded
from pipeline.run_folder import Run
from pipeline.train_spec import TrainSpec

if TYPE_CHECKING:
    from stable_baselines3.common.running_mean_std import RunningMeanStd
    from stable_baselines3.common.vec_env import VecEnv

# What a VecNormalize is told when it is made, beside whether it goes on learning.
_SETTINGS = (
    "norm_obs",
    "norm_reward",
    "clip_obs",
    "clip_reward",
    "gamma",
    "epsilon",
    "norm_obs_keys",
)


@dataclass(frozen=True)
class Statistics:
    """What a VecNormalize has seen, and how it normalises by it.

    Attributes:
        path: where they were read.
        settings: arguments of VecNormalize.
        observations: of each observation, or by key; None where observations are left alone.
        returns: of discounted returns, by which rewards are divided.
    """

    path: Path
    settings: Mapping[str, Any]
    observations: RunningMeanStd | dict[str, RunningMeanStd] | None
    returns: RunningMeanStd


def read_statistics(path: Path, run: Run | None = None) -> Statistics:
    """Read what VecNormalize saved, as data: nothing in the file is run.

    Args:
        path: the file.
        run: the run that it is of, whose record says what it was, or None.

    Raises:
        UserError: if the file is no such thing, or not as the run left it.
    """
    from safe_files.buffers_and_statistics import read_normalization
    from safe_files.files import MAX_STATISTICS_BYTES

    try:
        saved = read_normalization(read_recorded(run, path, MAX_STATISTICS_BYTES))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error
    settings = {key: saved.settings[key] for key in _SETTINGS if saved.settings[key] is not None}
    return Statistics(
        path,
        {key: _plain(value) for key, value in settings.items()},
        saved.obs_rms if saved.settings["norm_obs"] else None,
        saved.ret_rms,
    )


def normalising(spec: TrainSpec, settings: Mapping[str, Any]) -> TrainSpec:
    """The spec with environments under a VecNormalize that is made with ``settings``."""
    return replace(
        spec,
        hyperparams=replace(spec.hyperparams, normalize=dict(settings)),
        saved_hyperparams={**spec.saved_hyperparams, "normalize": dict(settings)},
    )


def take_over(env: VecEnv, statistics: Statistics) -> None:
    """Let the VecNormalize in ``env`` go on from the statistics.

    Raises:
        UserError: if they are of other observations.
    """
    from stable_baselines3.common.vec_env import unwrap_vec_normalize

    normalization = unwrap_vec_normalize(env)
    assert normalization is not None, "see `normalising`"
    if normalization.norm_obs and statistics.observations is not None:
        wanted, found = _shapes(normalization.obs_rms), _shapes(statistics.observations)
        if wanted != found:
            raise UserError(
                f"{statistics.path} holds statistics of observations of shape {found}; the "
                f"environment gives {wanted}"
            )
        normalization.obs_rms = statistics.observations  # type: ignore[assignment]
    normalization.ret_rms = statistics.returns


def with_normalised_rewards(env: VecEnv) -> VecEnv:
    """The environments with rewards as training normalised them, episodes' returns too.

    Raises:
        UserError: if nothing normalises in ``env``.
    """
    from stable_baselines3.common.vec_env import VecMonitor, unwrap_vec_normalize

    normalization = unwrap_vec_normalize(env)
    if normalization is None:
        raise UserError("--norm-reward: no statistics of VecNormalize belong to this model")
    normalization.norm_reward = True
    with warnings.catch_warnings():
        # That the statistics of the Monitor inside are overwritten is what is wanted.
        warnings.filterwarnings("ignore", "The environment is already wrapped with a `Monitor`")
        return VecMonitor(env)


def _plain(value: Any) -> Any:
    """NumPy's numbers as Python's, which a settings file can hold."""
    return value.item() if hasattr(value, "item") else value


def _shapes(statistics: Any) -> Any:
    if isinstance(statistics, dict):
        return {key: value.mean.shape for key, value in statistics.items()}
    return statistics.mean.shape
