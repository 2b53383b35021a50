"""Loads models of Stable-Baselines3 and sb3-contrib from files of unknown origin.

The library's own `load` gets a new zip with the checked contents, so it has nothing to unpickle.
Sizes are checked, because it would make networks and buffers of any size in the settings.
"""

from __future__ import annotations

import base64
import contextlib
import inspect
import io
import json
import os
import sys
import textwrap
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from torch.overrides import TorchFunctionMode

from rl_yardstick.safe_files import files, known_objects
from rl_yardstick.safe_files.files import SETTINGS, TENSORS, Budget, Source, UnsafeFileError, shown
from rl_yardstick.safe_files.old_versions import update
from rl_yardstick.safe_files.pickles import Reader

# Attributes that models do not keep: the caller sets them, regardless of the file.
_NOT_KEPT = frozenset(
    {"env", "device", "policy", "rollout_buffer", "replay_buffer", "_logger", "_custom_logger"}
    | {"_vec_normalize_env", "_episode_storage"}
)
# The caller's as well, or rebuilt from the learning rate and the exploration settings.
_NOT_READ = _NOT_KEPT | {"tensorboard_log", "lr_schedule", "exploration_schedule"}
_SERIALIZED = ":serialized:"

Algorithm = TypeVar("Algorithm", bound=BaseAlgorithm)


def load_model(
    algorithm: type[Algorithm],
    path: Source,
    env: Any = None,
    *,
    device: th.device | str = "auto",
    classes: Mapping[str, type] | None = None,
    custom_objects: Mapping[str, Any] | None = None,
    **replaced: Any,
) -> Algorithm:
    """Like ``algorithm.load`` of a path or a stream, but runs no code from the file.

    Args:
        algorithm: a class of Stable-Baselines3, sb3-contrib, or your own with the same interface.
        path: the zip, or a stream of its bytes.
        env: the environment for further training, or None.
        device: the device of the tensors.
        classes: your own classes that the file may name, by their full names.
        custom_objects: values that replace attributes in the file, which are then not read.
        replaced: the same, also for attributes that the file lacks.

    Raises:
        UnsafeFileError: if the file has forbidden contents, is damaged, or is too large.
        ValueError: if the model does not fit ``env``; the message is the library's.
    """
    members, raw, budget = files.read_model(files.content_of(path, files.MAX_ARCHIVE_BYTES))
    settings = {key: _decoded(value) for key, value in raw.items() if key not in _NOT_READ}
    for key in settings:
        if not key.isidentifier() or key.startswith("__") or hides(algorithm, key):
            raise UnsafeFileError(f"sets {shown(key)}, which is no attribute of a model", key)
    known = {**known_objects.by_name(algorithm.policy_aliases.values()), **(classes or {})}
    objects = {name: held for name, held in (custom_objects or {}).items() if name in settings}
    pickled = {name: held for name, held in settings.items() if isinstance(held, bytes)}
    for key in pickled.keys() - objects - replaced.keys():
        try:
            objects[key] = known_objects.read_pickle(pickled[key], known, budget=budget)
        except UnsafeFileError as error:
            raise UnsafeFileError(f"{key} {error}", key) from error
    names = [name for name in members if name.endswith(TENSORS)]
    tensors = {name: known_objects.load_tensors(members.pop(name), budget) for name in names}
    known_objects.check_values(tensors)
    try:
        changes = update(tensors, {**settings, **objects, **replaced})
        objects |= {key: value for key, value in changes.items() if key not in replaced}
        _check_variables(tensors, algorithm)
        _check_buffers({**settings, **objects, **replaced})
        # The library applies only custom objects whose keys are in the file.
        data = {**settings, **dict.fromkeys([*pickled, *objects])}
        checked = io.BytesIO()
        with zipfile.ZipFile(checked, "w") as archive:
            archive.writestr(SETTINGS, json.dumps(data))
            for name in names:  # what is written needs no second place in memory
                with archive.open(name, "w") as member:
                    th.save(tensors.pop(name), member)
        checked.seek(0)
        with charged_tensors(budget):
            return algorithm.load(checked, env, device, objects, **replaced)
    except ValueError:
        raise  # UnsafeFileError, or the model does not fit the environment
    except Exception as error:  # settings and weights that do not match can fail anywhere
        reason = textwrap.shorten(str(error), 200) or type(error).__name__
        raise UnsafeFileError(f"holds no such model: {reason}") from error


def hides(algorithm: type, name: str) -> bool:
    """Whether an attribute of that name would hide a class member other than a plain default."""
    default = inspect.getattr_static(algorithm, name, None)
    return not isinstance(default, bool | int | float | str | None)


def _decoded(value: Any) -> Any:
    """An attribute in JSON; its pickle, if it has one, which JSON holds as base64."""
    if not (isinstance(value, dict) and _SERIALIZED in value):
        return value
    with files.refused_as("holds a damaged pickle"):
        return base64.b64decode(value[_SERIALIZED], validate=True)


def _check_variables(tensors: Mapping[str, Any], algorithm: type[BaseAlgorithm]) -> None:
    """Refuse variables that the library never writes, because it would set any attribute."""
    known = {"log_ent_coef", "ent_coef_tensor"}  # the entropy coefficient of SAC
    # For the libraries' classes, an empty instance is enough, or these are the variables.
    with contextlib.suppress(AttributeError):
        known |= set(algorithm._get_torch_save_params(algorithm.__new__(algorithm))[1])
    for name in ("pytorch_variables.pth", "tensors.pth"):  # the second is the older one
        for key in tensors.get(name, {}):
            if key not in known:
                raise UnsafeFileError(f"sets {shown(key)}, which is no variable of a model")


# --- sizes ----------------------------------------------------------------------------------------

# Bytes of a number in a buffer, and of the dictionary that `HerReplayBuffer` keeps for each step.
_BYTES_PER_NUMBER, _BYTES_PER_INFO = 4, 136
# Operations that make new tensors of given sizes, or of existing ones.
_MAKERS = frozenset(
    {th.empty, th.zeros, th.ones, th.full, th.rand, th.randn, th.eye, th.arange, th.Tensor.repeat}
    | {th.empty_like, th.zeros_like, th.ones_like, th.Tensor.clone, th.clone}
)
_BYTES_PER_TENSOR = 4096  # Python's overhead of a tensor and its layer


class charged_tensors(TorchFunctionMode):  # noqa: N801  # it is used as a function is
    """A mode of PyTorch that charges the budget for each tensor before it is made."""

    def __init__(self, budget: Budget) -> None:
        super().__init__()
        self.budget = budget

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in _MAKERS:
            # PyTorch's device for tensors without memory.
            like = [arg.to("meta") if isinstance(arg, th.Tensor) else arg for arg in args]
            where = {} if like and isinstance(like[0], th.Tensor) else {"device": "meta"}
            self.budget.charge(func(*like, **{**kwargs, **where}).nbytes + _BYTES_PER_TENSOR)
        return func(*args, **kwargs)


def _check_buffers(settings: Mapping[str, Any]) -> None:
    """Check that the buffers in the settings fit into memory."""
    most = 16 << 30  # bytes, if the system does not report its memory
    if sys.platform != "win32":
        with contextlib.suppress(ValueError, OSError):
            most = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    row = get_flattened_obs_dim(settings["observation_space"]) * _BYTES_PER_NUMBER + _BYTES_PER_INFO
    for name, factor in (("buffer_size", 1), ("n_steps", settings.get("n_envs", 1))):
        if not 0 < settings.get(name, 1) * factor * row <= most:
            raise UnsafeFileError(f"does not fit into memory here: give another {name}", name)


# --- inspecting a zip, without making a model from it ---------------------------------------------


def inspect_model(path: Path | str) -> dict[str, dict[str, str]]:
    """What a model's zip holds, in words; UnsafeFileError if the file is not one.

    Returns:
        for each of ``"members"``, ``"weights"``, ``"settings"`` and ``"suspicious"``, texts of one
        line by name.
    """
    members, settings, budget = files.read_model(files.content_of(path, files.MAX_ARCHIVE_BYTES))
    kinds = "members", "weights", "settings", "suspicious"
    found: dict[str, dict[str, str]] = {kind: {} for kind in kinds}
    for key, value in settings.items():
        name = shown(key)[1:-1]
        try:
            found["settings"][name] = _setting(key, value, budget)
        except UnsafeFileError as error:
            found["suspicious"][name] = str(error)
    for member, held in members.items():
        name = shown(member)[1:-1]
        found["members"][name] = f"{len(held):,} bytes"
        try:
            stem = member.removesuffix(TENSORS)
            tensors = {stem: known_objects.load_tensors(held, budget)} if stem != member else {}
            known_objects.check_values(tensors)
            for where, tensor in known_objects.tensors_in(tensors):
                found["weights"][shown(where)[1:-1]] = str(tuple(tensor.shape))
        except UnsafeFileError as error:
            found["suspicious"][name] = str(error)
    return found


def _setting(key: str, value: Any, budget: Budget) -> str:
    """An attribute in one line; UnsafeFileError if it is suspicious."""
    if key in _NOT_KEPT and value:
        raise UnsafeFileError("is set, which models do not keep")
    pickled = _decoded(value)
    if not isinstance(pickled, bytes):
        return shown(value)
    reader = Reader(io.BytesIO(pickled), budget)
    reader.load()
    names = [shown(name)[1:-1] for name in sorted(reader.names)]
    if key != "policy_class" or not names[0].startswith(("stable_baselines3.", "sb3_contrib.")):
        known_objects.read_pickle(pickled, budget=budget)
    return "a pickle of " + (", ".join(names) or "plain data")
