"""Loads replay buffers and VecNormalize statistics from files of unknown origin."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from rl_yardstick.safe_files.files import (
    MAX_BUFFER_BYTES,
    MAX_STATISTICS_BYTES,
    Source,
    UnsafeFileError,
    content_of,
)
from rl_yardstick.safe_files.known_objects import MAX_ROWS, by_name, read_pickle
from rl_yardstick.safe_files.pickles import Build, Made, fields, wrong

# --- replay buffers -------------------------------------------------------------------------------

_CLASSES = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer)
_ARGUMENTS = ("buffer_size", "n_envs", "optimize_memory_usage", "handle_timeout_termination")
_MORE_ARGUMENTS: Mapping[type, tuple[str, ...]] = {
    NStepReplayBuffer: ("n_steps", "gamma"),
    HerReplayBuffer: ("n_sampled_goal", "goal_selection_strategy", "copy_info_dict"),
}


class _Stored(NamedTuple):
    cls: type[ReplayBuffer]
    state: Mapping[str, Any]  # its attributes


def load_replay_buffer(
    model: OffPolicyAlgorithm,
    path: Source,
    truncate_last_traj: bool = True,
    *,
    classes: Iterable[type[ReplayBuffer]] = (),
) -> None:
    """Like ``model.load_replay_buffer``, but runs no code from the file.

    Args:
        model: the agent to give the buffer to.
        path: the file, or a stream of its bytes.
        truncate_last_traj: with `HerReplayBuffer`, end the unfinished episode in the buffer.
        classes: your own subclasses that the file may name, with `ReplayBuffer`'s arguments.

    Raises:
        UnsafeFileError: if the file is not a replay buffer, or does not fit the model.
    """
    known: tuple[type[ReplayBuffer], ...] = (*_CLASSES, *classes)
    makers = {name: partial(_stored, cls) for name, cls in by_name(known).items()}
    found = read_pickle(content_of(path, MAX_BUFFER_BYTES), makers=makers)
    if not isinstance(found, _Stored):
        raise UnsafeFileError("holds no replay buffer")
    for name in ("observation_space", "action_space"):
        if found.state.get(name) != getattr(model, name):
            raise UnsafeFileError(f"holds transitions of another {name} than the agent's")
    buffer = _buffer(found, model.device)
    if isinstance(buffer, HerReplayBuffer):
        assert model.env is not None, "HerReplayBuffer needs an environment"
        buffer.set_env(model.env)
        if truncate_last_traj:
            buffer.truncate_last_trajectory()
    model.replay_buffer = buffer


def _stored(cls: type[ReplayBuffer], made: Made, build: Build) -> _Stored:
    state = fields(made, build)
    rows = state.get("buffer_size")
    if not (isinstance(rows, int) and 0 < rows <= MAX_ROWS):
        raise wrong(made)
    return _Stored(cls, state)


def _buffer(found: _Stored, device: th.device) -> ReplayBuffer:
    """Make a buffer by its constructor, and fill it."""
    state = dict(found.state)
    names = (*_ARGUMENTS, *_MORE_ARGUMENTS.get(found.cls, ()))
    given: dict[str, Any] = {name: state[name] for name in names if name in state}
    shape = (given["buffer_size"], given.get("n_envs", 1))
    # The file has the rows per environment, the constructor takes the total.
    given["buffer_size"] *= given.get("n_envs", 1)
    if found.cls is HerReplayBuffer:
        given["env"] = None
        # The constructor makes a dictionary for each row: the file must contain as many.
        if not isinstance(state.get("infos"), np.ndarray) or state["infos"].shape != shape:
            raise UnsafeFileError("holds a replay buffer with wrong infos")
    try:
        given |= {name: state[name] for name in ("observation_space", "action_space")}
        buffer = found.cls(device=device, **given)
    except (LookupError, TypeError, ValueError, AssertionError, MemoryError) as error:
        raise UnsafeFileError(f"holds a replay buffer that cannot be made: {error}") from error
    state.pop("device", None)
    for name, value in state.items():
        _check_part(name, value, vars(buffer).get(name))
        setattr(buffer, name, value)
    return buffer


def _check_part(name: str, value: Any, expected: Any) -> None:
    """Check type, shape and range of a buffer's attribute against those of an empty buffer."""
    if isinstance(expected, dict):
        if not isinstance(value, dict) or value.keys() != expected.keys():
            raise UnsafeFileError(f"holds a replay buffer with wrong {name}")
        for key, part in value.items():
            _check_part(name, part, expected[key])
        return
    fits = type(value) is type(expected)
    if isinstance(expected, np.ndarray) and fits:
        fits = value.shape == expected.shape and value.dtype == expected.dtype
        fits = fits and (value.dtype.kind != "f" or bool(np.isfinite(value).all()))
    if isinstance(expected, spaces.Space | int) and not isinstance(expected, bool) and fits:
        fits = name == "pos" or value == expected
    if not fits:
        raise UnsafeFileError(f"holds a replay buffer with wrong {name}")


# --- statistics -----------------------------------------------------------------------------------

_VEC_NORMALIZE = "stable_baselines3.common.vec_env.vec_normalize.VecNormalize"
_FLAGS = ("training", "norm_obs", "norm_reward")
_NUMBERS = ("clip_obs", "clip_reward", "gamma", "epsilon")
_REST = ("observation_space", "obs_rms", "ret_rms")


@dataclass(frozen=True)
class Normalization:
    """The settings and statistics of a `VecNormalize` in a file."""

    settings: dict[str, Any]  # its constructor's arguments
    observation_space: spaces.Space[Any]
    # A dictionary for Dict observations, None if observations are not normalised.
    obs_rms: RunningMeanStd | dict[str, RunningMeanStd] | None
    ret_rms: RunningMeanStd


def load_vec_normalize(path: Source, venv: VecEnv) -> VecNormalize:
    """Like `VecNormalize.load` of a path or stream, but runs no code from the file.

    Raises:
        UnsafeFileError: if the file has no such statistics, or they do not fit the environments.
    """
    found, space = (
        read_normalization(content_of(path, MAX_STATISTICS_BYTES)),
        venv.observation_space,
    )
    known, rms = found.observation_space, found.obs_rms
    if type(known) is not type(space) or known.shape != space.shape:
        raise UnsafeFileError(f"holds statistics of {known}, not of {space}")
    parts: dict[Any, Any] = dict(rms) if isinstance(rms, dict) else {None: rms} if rms else {}
    for key, statistics in parts.items():
        part = space[key] if isinstance(space, spaces.Dict) and key in space.spaces else space
        if np.shape(statistics.mean) != part.shape or np.shape(statistics.var) != part.shape:
            raise UnsafeFileError(f"holds statistics of another shape than {part.shape}")
    normalized = VecNormalize(venv, **found.settings)
    if found.obs_rms is not None:
        normalized.obs_rms = cast(Any, found.obs_rms)
    normalized.ret_rms = found.ret_rms
    return normalized


def read_normalization(pickled: bytes) -> Normalization:
    """Read the statistics in a pickled `VecNormalize`."""
    found = read_pickle(pickled, makers={_VEC_NORMALIZE: _normalization})
    if not isinstance(found, Normalization):
        raise UnsafeFileError("holds no statistics of VecNormalize")
    return found


def _normalization(made: Made, build: Build) -> Normalization:
    # Its other attributes are ignored.
    trees = made.state if isinstance(made.state, dict) else {}
    if not trees.keys() >= {*_FLAGS, *_NUMBERS, *_REST}:
        raise wrong(made)
    state = {name: build(trees[name]) for name in (*_FLAGS, *_NUMBERS, *_REST)}
    settings = {name: state[name] for name in (*_FLAGS, *_NUMBERS)}
    # Older files lack it.
    keys = trees.get("norm_obs_keys")
    settings["norm_obs_keys"] = build(keys) if isinstance(keys, list) else None
    fits = (
        all(isinstance(state[name], bool) for name in _FLAGS)
        and all(_is_number(state[name]) for name in _NUMBERS)
        and isinstance(state["observation_space"], spaces.Space)
        and isinstance(state["ret_rms"], RunningMeanStd)
        and all(isinstance(key, str) for key in settings["norm_obs_keys"] or ())
    )
    obs_rms = state["obs_rms"]
    parts = obs_rms.values() if isinstance(obs_rms, dict) else [obs_rms]
    if not fits or (state["norm_obs"] and not all(isinstance(p, RunningMeanStd) for p in parts)):
        raise wrong(made)
    return Normalization(settings, state["observation_space"], obs_rms, state["ret_rms"])


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))
