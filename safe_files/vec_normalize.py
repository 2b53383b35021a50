"""VecNormalize's statistics, read from files of unknown origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from safe_files.limits import MAX_STATISTICS_BYTES
from safe_files.objects import read_pickle
from safe_files.pickle_trees import Made
from safe_files.rebuilding import Build, chosen_fields, wrong
from safe_files.refusals import UnsafeFileError
from safe_files.regular_files import Source, content_of

_CLASS = "stable_baselines3.common.vec_env.vec_normalize.VecNormalize"
_FLAGS = ("training", "norm_obs", "norm_reward")
_NUMBERS = ("clip_obs", "clip_reward", "gamma", "epsilon")
_REST = ("observation_space", "obs_rms", "ret_rms")


@dataclass(frozen=True)
class Normalization:
    """What a file says of a `VecNormalize`."""

    settings: dict[str, Any]  # its constructor's arguments
    observation_space: spaces.Space[Any]
    # A dictionary where observations are dictionaries, None where they are left as they are.
    obs_rms: RunningMeanStd | dict[str, RunningMeanStd] | None
    ret_rms: RunningMeanStd


def load_vec_normalize(path: Source, venv: VecEnv) -> VecNormalize:
    """As `VecNormalize.load`, without running anything that the file names.

    Args:
        path: the file, or a stream of its bytes.
        venv: the environments to normalise.

    Raises:
        UnsafeFileError: if the file is no such statistics, or they do not fit the environments.
        OSError: if it cannot be read.
    """
    found = read_normalization(content_of(path, MAX_STATISTICS_BYTES))
    _check_fit(found, venv.observation_space)
    normalized = VecNormalize(venv, **found.settings)
    if found.obs_rms is not None:
        normalized.obs_rms = cast(Any, found.obs_rms)
    normalized.ret_rms = found.ret_rms
    return normalized


def read_normalization(pickled: bytes) -> Normalization:
    """The statistics in a pickled `VecNormalize`."""
    found = read_pickle(pickled, makers={_CLASS: _normalization})
    if not isinstance(found, Normalization):
        raise UnsafeFileError("holds no statistics of VecNormalize")
    return found


def _normalization(made: Made, build: Build) -> Normalization:
    state = chosen_fields(made, build, (*_FLAGS, *_NUMBERS, *_REST))
    settings = {name: state[name] for name in (*_FLAGS, *_NUMBERS)}
    # Files from before there was a choice of keys do not say it.
    keys = _observed_keys(made, build)
    fits = (
        all(isinstance(state[name], bool) for name in _FLAGS)
        and all(_is_number(state[name]) for name in _NUMBERS)
        and isinstance(state["observation_space"], spaces.Space)
        and isinstance(state["ret_rms"], RunningMeanStd)
        and (keys is None or all(isinstance(key, str) for key in keys))
    )
    obs_rms = state["obs_rms"]
    parts = obs_rms.values() if isinstance(obs_rms, dict) else [obs_rms]
    if not fits or (state["norm_obs"] and not all(isinstance(p, RunningMeanStd) for p in parts)):
        raise wrong(made)
    settings["norm_obs_keys"] = keys
    return Normalization(settings, state["observation_space"], obs_rms, state["ret_rms"])


def _observed_keys(made: Made, build: Build) -> list[str] | None:
    try:
        keys = chosen_fields(made, build, ["norm_obs_keys"])["norm_obs_keys"]
    except UnsafeFileError:
        return None
    return keys if isinstance(keys, list) else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def _check_fit(found: Normalization, space: spaces.Space[Any]) -> None:
    """Make sure that the statistics are of observations such as these."""
    if found.observation_space.shape != space.shape or type(found.observation_space) is not type(
        space
    ):
        raise UnsafeFileError(f"holds statistics of {found.observation_space}, not of {space}")
    if found.obs_rms is None:
        return
    rms = found.obs_rms
    parts: dict[Any, Any] = dict(rms) if isinstance(rms, dict) else {None: rms}
    for key, statistics in parts.items():
        part = space[key] if isinstance(space, spaces.Dict) and key in space.spaces else space
        if np.shape(statistics.mean) != part.shape or np.shape(statistics.var) != part.shape:
            raise UnsafeFileError(f"holds statistics of another shape than {part.shape}")
