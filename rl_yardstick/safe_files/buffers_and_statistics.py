"""Loads replay buffers and VecNormalize statistics from files of unknown origin."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from rl_yardstick.safe_files.files import Source, UnsafeFileError, content_of
from rl_yardstick.safe_files.known_objects import by_name, filled, read_pickle
from rl_yardstick.safe_files.pickles import Build, Made, fields, wrong

_MAX_BYTES = 32 << 30

# --- replay buffers -------------------------------------------------------------------------------

_CLASSES = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer)
# Arrays with a row for each step of each environment.
_ROWS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "infos")


def load_replay_buffer(
    model: OffPolicyAlgorithm, path: Source, *, classes: Iterable[type[ReplayBuffer]] = ()
) -> None:
    """Like ``model.load_replay_buffer`` of a path or stream, but runs no code from the file.

    ``classes`` are your own subclasses of `ReplayBuffer` that the file may name.

    Raises:
        UnsafeFileError: if the file is not a replay buffer, or does not fit the model.
    """
    makers = {name: partial(filled, cls) for name, cls in by_name([*_CLASSES, *classes]).items()}
    buffer = read_pickle(content_of(path, _MAX_BYTES), makers=makers)
    if not isinstance(buffer, ReplayBuffer):
        raise UnsafeFileError("holds no replay buffer")
    state, like = vars(buffer), model.replay_buffer
    if type(like) is type(buffer) and (lacks := vars(like).keys() - state):  # hindsight, before 1.8
        name = f"{type(buffer).__name__} of an older version"
        raise UnsafeFileError(f"holds a {name}, without {', '.join(sorted(lacks))}")
    for name in ("observation_space", "action_space"):
        if state.get(name) != getattr(model, name):
            raise UnsafeFileError(f"holds transitions of another {name} than the agent's")
    for name in _ROWS:
        held = state.get(name, {})
        for array in held.values() if isinstance(held, dict) else [held]:
            fits = array.shape[:2] == (state.get("buffer_size"), state.get("n_envs"))
            is_finite = array.dtype == object if name == "infos" else np.isfinite(array).all()
            if not (fits and is_finite):
                raise UnsafeFileError(f"holds a replay buffer with wrong {name}")
    buffer.device = model.device
    if isinstance(buffer, HerReplayBuffer):
        assert model.env is not None, "HerReplayBuffer needs an environment"
        buffer.set_env(model.env)
        buffer.truncate_last_trajectory()
    model.replay_buffer = buffer


# --- statistics -----------------------------------------------------------------------------------

_SETTINGS = ["training", "norm_obs", "norm_reward", "clip_obs", "clip_reward", "gamma", "epsilon"]
_REST = ("observation_space", "obs_rms", "ret_rms")


@dataclass(frozen=True)
class Normalization:
    """The settings and statistics of a `VecNormalize` in a file."""

    settings: dict[str, Any]  # its constructor's arguments
    observation_space: spaces.Space[Any]
    obs_rms: RunningMeanStd | dict[str, RunningMeanStd] | None  # None if it does not normalise them
    ret_rms: RunningMeanStd


def load_vec_normalize(path: Source, venv: VecEnv) -> VecNormalize:
    """Like `VecNormalize.load` of a path or stream, but runs no code from the file.

    Raises:
        UnsafeFileError: if the file has no such statistics, or they do not fit the environments.
    """
    found = read_normalization(content_of(path, _MAX_BYTES))
    known, space = found.observation_space, venv.observation_space
    if type(known) is not type(space) or known.shape != space.shape:
        raise UnsafeFileError(f"holds statistics of {known}, not of {space}")
    normalized = VecNormalize(venv, **found.settings)
    if found.obs_rms is not None:
        normalized.obs_rms = cast(Any, found.obs_rms)
    normalized.ret_rms = found.ret_rms
    return normalized


def read_normalization(pickled: bytes) -> Normalization:
    """Read the statistics in a pickled `VecNormalize`."""
    found = read_pickle(pickled, makers=dict.fromkeys(by_name([VecNormalize]), _normalization))
    if not isinstance(found, Normalization):
        raise UnsafeFileError("holds no statistics of VecNormalize")
    return found


def _normalization(made: Made, build: Build) -> Normalization:
    # Its other attributes are ignored. Older files lack the keys.
    state = fields(made, build, (*_SETTINGS, *_REST, "norm_obs_keys"))
    space, obs_rms, ret_rms = map(state.pop, _REST)
    parts = obs_rms.values() if isinstance(obs_rms, dict) else [obs_rms]
    fits = (
        all(isinstance(state[name], bool | int | float | np.number) for name in _SETTINGS)
        and isinstance(space, spaces.Space)
        and isinstance(ret_rms, RunningMeanStd)
        and (all(isinstance(rms, RunningMeanStd) for rms in parts) or not state["norm_obs"])
    )
    if not fits:
        raise wrong(made)
    return Normalization({"norm_obs_keys": None, **state}, space, obs_rms, ret_rms)
