"""Loads models of Stable-Baselines3 and sb3-contrib from files of unknown origin.

The library's own `load` gets a new zip with the checked contents, so it has nothing to unpickle.
This module also checks sizes and dtypes, because `load` would make networks and buffers of any size
in the settings, and PyTorch silently converts dtypes.
"""

from __future__ import annotations

import base64
import binascii
import inspect
import io
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch import nn, optim
from torch.overrides import TorchFunctionMode

from rl_yardstick.safe_files.archives import (
    MEMBERS,
    SETTINGS,
    TENSORS,
    parse_settings,
    read_members,
)
from rl_yardstick.safe_files.files import (
    MAX_ARCHIVE_BYTES,
    Budget,
    Source,
    UnsafeFileError,
    content_of,
    memory_bytes,
    read_file,
    shown,
)
from rl_yardstick.safe_files.known_objects import (
    MAX_ROWS,
    all_policy_classes,
    check_values,
    load_tensors,
    policy_classes,
    read_pickle,
    tensors_in,
)
from rl_yardstick.safe_files.pickles import Reader

# Trained variables outside networks, such as the entropy coefficient of SAC.
_OF_ENTROPY = frozenset({"log_ent_coef", "ent_coef_tensor"})

# The files of these variables; the second name is the older one.
_VARIABLES = frozenset({"pytorch_variables.pth", "tensors.pth"})

# Attributes that the caller sets, regardless of the file.
_NOT_READ = frozenset(
    {"env", "device", "policy", "rollout_buffer", "replay_buffer", "tensorboard_log"}
    | {"_logger", "_custom_logger", "_vec_normalize_env", "_episode_storage"}
)
# Rebuilt from the learning rate and the exploration settings.
_DERIVED = frozenset({"lr_schedule", "exploration_schedule"})
_SERIALIZED = ":serialized:"

# Types of a class's default value of an attribute.
_PLAIN = (bool, int, float, str, type(None))

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
    """Like ``algorithm.load``, but runs no code from the file.

    Args:
        algorithm: a class of Stable-Baselines3, sb3-contrib, or your own with the same interface.
        path: the zip, or a stream of its bytes.
        env: the environment for further training, or None.
        device: the device of the tensors.
        classes: your own classes that the file may name, by their full names.
        custom_objects: values that replace attributes in the file, which are then not read.
        replaced: attributes to set, also if the file lacks them; the file's values are not read.

    Raises:
        UnsafeFileError: if the file has forbidden contents, is damaged, or is too large.
        ValueError: if the model does not fit ``env``; the message is the library's.
    """
    files, variables = _tensors_of(algorithm)
    content = content_of(path, MAX_ARCHIVE_BYTES)
    budget = Budget(len(content))
    members = read_members(content, MEMBERS | files, budget)
    plain, pickled = _read_settings(members, algorithm, budget)
    known = {**policy_classes(algorithm), **(classes or {})}
    given = custom_objects or {}
    objects = {name: given[name] for name in given if name in plain or name in pickled}
    for key in [key for key in pickled if key not in objects and key not in replaced]:
        try:
            objects[key] = read_pickle(pickled[key], known, budget=budget)
        except UnsafeFileError as error:
            raise UnsafeFileError(f"{key} {error}", key) from error
    if not isinstance(objects.get("policy_class"), type):
        raise UnsafeFileError("does not say its policy's class", "policy_class")
    names = sorted(files & set(members))
    tensors = {name: load_tensors(members.pop(name), budget) for name in names}
    check_values(tensors)
    _check_variables(tensors, variables)
    _check_sizes({**plain, **objects, **replaced}, budget)
    # The library applies only custom objects whose keys are in the file.
    data = json.dumps({**plain, **dict.fromkeys(objects)}).encode()
    try:
        with charged_tensors(budget):
            model = _with_tensors(algorithm, tensors).load(
                _zipped(data, tensors), env=env, device=device, custom_objects=objects, **replaced
            )
        model.__class__ = algorithm
        _check_fit(model, tensors)
    except ValueError:
        raise  # the model does not fit the environment
    except Exception as error:  # settings and weights that do not match can fail anywhere
        lines = str(error).strip().splitlines()
        # PyTorch's first line is a heading; the next line names the tensor.
        n_lines = 2 if lines and lines[0].endswith(":") else 1
        text = " ".join(line.strip() for line in lines[:n_lines])
        reason = text.partition(". ")[0] or type(error).__name__
        raise UnsafeFileError(f"holds no such model: {reason}") from error
    return model


def _with_tensors(algorithm: type[Algorithm], tensors: Mapping[str, Any]) -> type[Algorithm]:
    """A subclass of the algorithm that loads these tensors for the names in the zip."""

    def set_parameters(
        self: BaseAlgorithm, found: Any, exact_match: bool = True, device: Any = "auto"
    ) -> None:
        for name, held in found.items():
            held.update(held or tensors[f"{name}.pth"])
        algorithm.set_parameters(self, found, exact_match, device)

    return type(algorithm.__name__, (algorithm,), {"set_parameters": set_parameters})


def _read_settings(
    members: Mapping[str, bytes], algorithm: type[BaseAlgorithm], budget: Budget
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The plain attributes in a zip, and the pickles of the others."""
    plain: dict[str, Any] = {}
    pickled: dict[str, bytes] = {}
    for key, value in parse_settings(members, budget).items():
        if key in _NOT_READ or key in _DERIVED:
            continue
        if not key.isidentifier() or key.startswith("__") or hides(algorithm, key):
            raise UnsafeFileError(f"sets {shown(key)}, which is no attribute of a model", key)
        if isinstance(value, dict) and _SERIALIZED in value:
            pickled[key] = _decoded(key, value[_SERIALIZED])
        else:
            plain[key] = value
    return plain, pickled


def hides(algorithm: type, name: str) -> bool:
    """Whether an attribute of that name would hide a class member other than a plain default."""
    return not isinstance(inspect.getattr_static(algorithm, name, None), _PLAIN)


def _tensors_of(algorithm: type[BaseAlgorithm]) -> tuple[frozenset[str], frozenset[str]]:
    """The tensor files of a model of this class, and its variables outside networks."""
    try:
        # For the libraries' classes, an empty instance is enough, or the defaults below are right.
        own: Any = algorithm._get_torch_save_params(algorithm.__new__(algorithm))
        files, variables = frozenset(f"{name}.pth" for name in own[0]), frozenset(own[1])
    except AttributeError:
        return TENSORS, _OF_ENTROPY
    return TENSORS | files, _OF_ENTROPY | variables


def _decoded(key: str, text: Any) -> bytes:
    """Decode a pickle from base64 in JSON."""
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, TypeError, ValueError) as error:
        raise UnsafeFileError(f"{key} is damaged: {error}", key) from error


def _check_variables(tensors: Mapping[str, Any], known: frozenset[str]) -> None:
    """Refuse variables that the library never writes, because it would set any attribute."""
    for name in sorted(_VARIABLES):
        variables = tensors.get(name, {})
        if not isinstance(variables, dict):
            raise UnsafeFileError(f"holds {name} that is not as the library writes it")
        strange = sorted(map(str, set(variables) - known))
        if strange:
            raise UnsafeFileError(f"sets {shown(strange[0])}, which is no variable of a model")
        for key in _OF_ENTROPY & set(variables):
            value = variables[key]
            is_tensor = isinstance(value, th.Tensor) and value.dtype == th.float32
            if not is_tensor or value.numel() != 1:
                what = "is not the one number of float32 that models have"
                raise UnsafeFileError(f"{name}: {key} {what}")


def _zipped(data: bytes, tensors: Mapping[str, Any]) -> io.BytesIO:
    """Write a new zip of the checked contents, with only the names of the parameters."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(SETTINGS, data)
        for name, held in tensors.items():
            with archive.open(name, "w") as member:
                th.save(held if name in _VARIABLES else {}, member)
    content.seek(0)
    return content


# --- checks of sizes and of tensors ---------------------------------------------------------------

# Attributes that determine the rows of a buffer; several of them multiply.
_BUFFERS = (("buffer_size",), ("n_steps", "n_envs"))
_FLAT_BYTES = 4
# Bytes per number of a network's trial input; the weights for each number take more.
_BYTES_PER_INPUT = 40
# Operations that make new tensors of given sizes, or of existing ones.
_MAKERS = frozenset(
    {th.empty, th.zeros, th.ones, th.full, th.rand, th.randn, th.eye, th.arange, th.Tensor.repeat}
    | {th.empty_like, th.zeros_like, th.ones_like, th.Tensor.clone, th.clone}
)
# Python's overhead of a tensor and its layer.
_BYTES_PER_TENSOR = 4096
# Bytes of the dictionary in which `HerReplayBuffer` keeps the info of each step.
_BYTES_PER_INFO = 136

# Optimizers whose state is numbers and tensors of the shape of each parameter.
_NAMES = "Adadelta Adagrad Adam Adamax AdamW ASGD NAdam RAdam RMSprop Rprop SGD"
_BY_ELEMENT = (*(getattr(optim, name) for name in _NAMES.split()), RMSpropTFLike)


class charged_tensors(TorchFunctionMode):  # noqa: N801  # it is used as a function is
    """A mode of PyTorch that charges the budget for each tensor before it is made."""

    def __init__(self, budget: Budget) -> None:
        super().__init__()
        self.budget = budget

    def __torch_function__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if function in _MAKERS:
            # PyTorch's device for tensors without memory.
            like = [arg.to("meta") if isinstance(arg, th.Tensor) else arg for arg in args]
            where = {} if like and isinstance(like[0], th.Tensor) else {"device": "meta"}
            self.budget.charge(function(*like, **{**kwargs, **where}).nbytes + _BYTES_PER_TENSOR)
        return function(*args, **kwargs)


def _check_sizes(settings: Mapping[str, Any], budget: Budget) -> None:
    """Check that the settings name their spaces, and that their buffers fit into memory."""
    for key in ("observation_space", "action_space"):
        if not isinstance(settings.get(key), spaces.Space):
            raise UnsafeFileError(f"does not say its {key}", key)
    n_inputs = get_flattened_obs_dim(settings["observation_space"])
    budget.charge(n_inputs * _BYTES_PER_INPUT)
    n_bytes = n_inputs * _FLAT_BYTES
    if settings.get("replay_buffer_class") is HerReplayBuffer:
        n_bytes += _BYTES_PER_INFO
    for names in _BUFFERS:
        values = [settings.get(name, 1) for name in names]
        if not all(isinstance(value, int) and 0 < value <= MAX_ROWS for value in values):
            raise UnsafeFileError(f"has {' and '.join(names)} outside the allowed range", names[0])
        size = math.prod(values) * n_bytes
        if size > memory_bytes():
            raise UnsafeFileError(
                f"asks for a buffer of {size:,} bytes, and this machine has {memory_bytes():,}: "
                f"give another {names[0]}",
                names[0],
            )


def _check_fit(model: BaseAlgorithm, tensors: Mapping[str, Any]) -> None:
    """Check dtypes and shapes of the tensors against those of the model."""
    for name in model._get_torch_save_params()[0]:
        part, found = recursive_getattr(model, name), tensors.get(f"{name}.pth", {})
        if isinstance(part, nn.Module):
            for key, like in part.state_dict().items():
                _check_alike(f"{name}.pth: {key}", found[key], like)
        elif isinstance(part, optim.Optimizer):
            _check_optimizer(f"{name}.pth", found, part)


def _check_alike(where: str, value: Any, like: Any) -> None:
    found, needed = (
        f"{str(one.dtype).removeprefix('torch.')} of shape {tuple(one.shape)}"
        if isinstance(one, th.Tensor)
        else type(one).__name__
        for one in (value, like)
    )
    if isinstance(like, th.Tensor) and found != needed:
        raise UnsafeFileError(f"{where} is {found}, and the model has {needed}")


def _check_optimizer(name: str, found: Any, optimizer: optim.Optimizer) -> None:
    for group in found["param_groups"]:
        for key, value in group.items():
            if key != "params" and not _is_setting(value, optimizer.defaults.get(key)):
                raise UnsafeFileError(f"{name}: {shown(key)} is {shown(value)}, no such setting")
    keys = [key for group in found["param_groups"] for key in group["params"]]
    own = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    if len(keys) != len(own):
        return  # DQN before 2.4: the library does not need it
    parameters = dict(zip(keys, own, strict=True))
    for key, state in found["state"].items():
        if key not in parameters:
            raise UnsafeFileError(f"{name}: {shown(key)} is no parameter of the model")
        for part, value in state.items() if isinstance(optimizer, _BY_ELEMENT) else ():
            is_tensor = isinstance(value, th.Tensor)
            is_number = is_tensor and value.numel() == 1 and value.is_floating_point()
            if not is_number and (is_tensor or not _is_setting(value, None)):
                where = f"{name}: {shown(part)} of {shown(key)}"
                _check_alike(where, value, parameters[key])


def _is_setting(value: Any, like: Any) -> bool:
    """Whether a value is a valid optimizer setting; ``like`` is the default."""
    if isinstance(like, tuple):
        fits = isinstance(value, tuple | list) and len(value) == len(like)
        return fits and all(_is_setting(*pair) for pair in zip(value, like, strict=True))
    if value is None or isinstance(value, bool):
        return like is None or isinstance(like, bool)
    is_number = isinstance(value, int | float) and math.isfinite(value)
    return is_number and not isinstance(like, bool)


# --- inspecting a zip, without making a model from it ---------------------------------------------


@dataclass(frozen=True)
class Report:
    """The contents of a model file."""

    sizes: dict[str, int]  #: bytes of each member of the zip
    weights: dict[str, tuple[int, ...]]  #: shapes of the tensors, by member and name
    settings: dict[str, str]  #: each attribute as a text of one line
    suspicious: tuple[str, ...]  #: warnings for the reader, each in one line


def inspect_model(path: Path | str) -> Report:
    """Inspect a model's zip; UnsafeFileError if the file is not one."""
    content = read_file(Path(path), MAX_ARCHIVE_BYTES)
    budget = Budget(len(content))
    members = read_members(content, MEMBERS, budget)
    settings: dict[str, str] = {}
    suspicious: list[str] = []
    for key, value in parse_settings(members, budget).items():
        settings[shown(key).strip("'")], doubts = _setting(key, value, budget)
        suspicious += doubts
    weights: dict[str, tuple[int, ...]] = {}
    for name in sorted(TENSORS & set(members)):
        try:
            tensors = load_tensors(members[name], budget)
            check_values({name: tensors})
        except UnsafeFileError as error:
            suspicious.append(f"{name} {error}")
        else:
            found = tensors_in(tensors, name.removesuffix(".pth"))
            weights |= {shown(where).strip("'"): tuple(tensor.shape) for where, tensor in found}
    sizes = {name: len(content) for name, content in members.items()}
    return Report(sizes, weights, settings, tuple(suspicious))


def _setting(key: str, value: Any, budget: Budget) -> tuple[str, list[str]]:
    """An attribute in one line, and a warning if it is suspicious."""
    is_odd = key in _NOT_READ - {"tensorboard_log"} and value
    name = shown(key).strip("'")
    doubts = [f"{name} is set, which models do not keep"] if is_odd else []
    if not (isinstance(value, dict) and _SERIALIZED in value):
        return shown(value), doubts
    try:
        pickled = _decoded(key, value[_SERIALIZED])
        reader = Reader(io.BytesIO(pickled), budget)
        reader.load()
        names = sorted({shown(name.name).strip("'") for name in reader.names})
        text = "a pickle of " + (", ".join(names) if names else "plain data")
    except UnsafeFileError as error:
        return "a pickle that cannot be read", [*doubts, f"{name} {error}"]
    try:
        read_pickle(pickled, all_policy_classes(), budget=budget)
    except UnsafeFileError as error:
        doubts.append(f"{name} {error}")
    return text, doubts
