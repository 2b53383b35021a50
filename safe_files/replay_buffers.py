"""Replay buffers, read from files of unknown origin."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from safe_files.limits import MAX_BUFFER_BYTES, MAX_ROWS
from safe_files.objects import full_name, read_pickle
from safe_files.pickle_trees import Made
from safe_files.rebuilding import Build, fields, wrong
from safe_files.refusals import UnsafeFileError
from safe_files.regular_files import Source, content_of

_CLASSES = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer)
_ARGUMENTS = ("buffer_size", "n_envs", "optimize_memory_usage", "handle_timeout_termination")
_MORE_ARGUMENTS: Mapping[type, tuple[str, ...]] = {
    NStepReplayBuffer: ("n_steps", "gamma"),
    HerReplayBuffer: ("n_sampled_goal", "goal_selection_strategy", "copy_info_dict"),
}


@dataclass(frozen=True)
class _Stored:
    """A buffer as the file says it: its class and its attributes."""

    cls: type[ReplayBuffer]
    state: Mapping[str, Any]


def load_replay_buffer(
    model: OffPolicyAlgorithm,
    path: Source,
    truncate_last_traj: bool = True,
    *,
    classes: Iterable[type[ReplayBuffer]] = (),
) -> None:
    """As ``model.load_replay_buffer``, without running anything that the file names.

    Args:
        model: the agent to give the buffer to.
        path: the file, or a stream of its bytes.
        truncate_last_traj: with `HerReplayBuffer`, end the episode under way in the buffer.
        classes: of your own, made with the arguments of `ReplayBuffer`, that the file may hold.

    Raises:
        UnsafeFileError: if the file is no replay buffer, or does not fit the model.
        OSError: if it cannot be read.
    """
    known: tuple[type[ReplayBuffer], ...] = (*_CLASSES, *classes)
    makers = {full_name(cls): partial(_stored, cls) for cls in known}
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
    """A buffer made by its constructor, and filled."""
    state = dict(found.state)
    names = (*_ARGUMENTS, *_MORE_ARGUMENTS.get(found.cls, ()))
    given: dict[str, Any] = {name: state[name] for name in names if name in state}
    # Its buffers count per environment.
    given["buffer_size"] *= given.get("n_envs", 1)
    if found.cls is HerReplayBuffer:
        given["env"] = None
    try:
        buffer = found.cls(
            observation_space=state["observation_space"],
            action_space=state["action_space"],
            device=device,
            **given,
        )
    except (LookupError, TypeError, ValueError, AssertionError, MemoryError) as error:
        raise UnsafeFileError(f"holds a replay buffer that cannot be made: {error}") from error
    state.pop("device", None)
    for name, value in state.items():
        _check_part(name, value, vars(buffer).get(name))
        setattr(buffer, name, value)
    return buffer


def _check_part(name: str, value: Any, expected: Any) -> None:
    """Make sure that an attribute of a buffer is such as an empty one has."""
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
