"""Whether the tensors of a file are of the kinds and shapes that the model's own parts have.

PyTorch turns one kind of numbers into another without a word, and looks at the shapes of an
optimizer's averages when they are used for the first time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn, optim

from safe_files.refusals import UnsafeFileError, shown

# Those that keep, of each parameter, tensors of its own shape, and numbers.
_BY_ELEMENT = (
    optim.Adadelta,
    optim.Adagrad,
    optim.Adam,
    optim.Adamax,
    optim.AdamW,
    optim.ASGD,
    optim.NAdam,
    optim.RAdam,
    optim.RMSprop,
    optim.Rprop,
    optim.SGD,
    RMSpropTFLike,
)


def check_fit(model: BaseAlgorithm, tensors: Mapping[str, Any]) -> None:
    """Make sure that a model could have written the tensors that it was given.

    Args:
        model: as it was loaded.
        tensors: what its files of tensors hold, by their names.

    Raises:
        UnsafeFileError: if one is of another kind or shape; it names the tensor.
    """
    for name in model._get_torch_save_params()[0]:
        part, found = recursive_getattr(model, name), tensors.get(f"{name}.pth", {})
        if isinstance(part, nn.Module):
            for key, like in part.state_dict().items():
                _check_alike(f"{name}.pth: {key}", found[key], like)
        elif isinstance(part, optim.Optimizer):
            _check_optimizer(f"{name}.pth", found, part)


def check_variable(name: str, value: Any) -> None:
    """Make sure that a variable beside the networks is one number.

    Raises:
        UnsafeFileError: if it is anything else.
    """
    if not (isinstance(value, th.Tensor) and value.dtype == th.float32 and value.numel() == 1):
        raise UnsafeFileError(f"{name} is not the one number of float32 that models have")


def _check_alike(where: str, value: Any, like: Any) -> None:
    if not isinstance(like, th.Tensor):
        return
    if not isinstance(value, th.Tensor) or (value.dtype, value.shape) != (like.dtype, like.shape):
        found = _described(value) if isinstance(value, th.Tensor) else type(value).__name__
        raise UnsafeFileError(f"{where} is {found}, and the model has {_described(like)}")


def _described(tensor: th.Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} of shape {tuple(tensor.shape)}"


def _check_optimizer(name: str, found: Any, optimizer: optim.Optimizer) -> None:
    for group in found["param_groups"]:
        for key, value in group.items():
            if key != "params" and not _is_setting(value, optimizer.defaults.get(key)):
                raise UnsafeFileError(f"{name}: {shown(key)} is {shown(value)}, no such setting")
    keys = [key for group in found["param_groups"] for key in group["params"]]
    own = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    if len(keys) != len(own):
        return  # of DQN before 2.4, which the library does without
    parameters = dict(zip(keys, own, strict=True))
    for key, state in found["state"].items():
        if key not in parameters:
            raise UnsafeFileError(f"{name}: {shown(key)} is no parameter of the model")
        if isinstance(optimizer, _BY_ELEMENT):
            for part, value in state.items():
                _check_state(f"{name}: {shown(part)} of {shown(key)}", value, parameters[key])


def _check_state(where: str, value: Any, parameter: th.Tensor) -> None:
    if isinstance(value, th.Tensor) and value.numel() == 1 and value.is_floating_point():
        return
    if isinstance(value, th.Tensor) or not _is_setting(value, None):
        _check_alike(where, value, parameter)


def _is_setting(value: Any, like: Any) -> bool:
    """Whether a value is such as an optimizer is told, where ``like`` is its default."""
    if isinstance(like, tuple):
        fits = isinstance(value, tuple | list) and len(value) == len(like)
        return fits and all(_is_setting(*pair) for pair in zip(value, like, strict=True))
    if value is None or isinstance(value, bool):
        return like is None or isinstance(like, bool)
    is_number = isinstance(value, int | float) and math.isfinite(value)
    return is_number and not isinstance(like, bool)
