"""Whether what a file asks for is in proportion to it, and its tensors those of such a model.

The library makes the networks that the settings describe before it looks at the weights, and the
buffers too: a file of some bytes could ask for all the memory that there is.

PyTorch turns one kind of numbers into another without a word, and looks at the shapes of an
optimizer's averages when they are used for the first time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn, optim
from torch.overrides import TorchFunctionMode

from safe_files.limits import MAX_ROWS, Budget, memory_bytes
from safe_files.refusals import UnsafeFileError, shown

# Attributes that say how many rows a buffer has; they multiply where there are several.
_BUFFER = ("buffer_size",)
_ROLLOUT = ("n_steps", "n_envs")
_FLAT_BYTES = 4
# Of what a network tries its input with; the weights behind each take more than that.
_BYTES_PER_INPUT = 40
# What makes new tensors of sizes that it is told, or of what is there already.
_MAKERS = frozenset(
    {th.empty, th.zeros, th.ones, th.full, th.rand, th.randn, th.eye, th.arange, th.Tensor.repeat}
    | {th.empty_like, th.zeros_like, th.ones_like, th.Tensor.clone, th.clone}
)
# Python's part of a tensor, and of the layer that has it.
_BYTES_PER_TENSOR = 4096

# Those that keep, of each parameter, tensors of its own shape, and numbers.
_NAMES = "Adadelta Adagrad Adam Adamax AdamW ASGD NAdam RAdam RMSprop Rprop SGD"
_BY_ELEMENT = (*(getattr(optim, name) for name in _NAMES.split()), RMSpropTFLike)


class charged_tensors(TorchFunctionMode):  # noqa: N801  # it is used as a function is
    """While it is entered, the budget pays for tensors before they are made."""

    def __init__(self, budget: Budget) -> None:
        super().__init__()
        self.budget = budget

    def __torch_function__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if function in _MAKERS:
            # PyTorch's own device for tensors that take no memory.
            like = [arg.to("meta") if isinstance(arg, th.Tensor) else arg for arg in args]
            where = {} if like and isinstance(like[0], th.Tensor) else {"device": "meta"}
            self.budget.charge(function(*like, **{**kwargs, **where}).nbytes + _BYTES_PER_TENSOR)
        return function(*args, **kwargs)


def check_sizes(settings: Mapping[str, Any], budget: Budget) -> None:
    """Make sure that the settings say their spaces, and that their buffers fit the memory."""
    for key in ("observation_space", "action_space"):
        if not isinstance(settings.get(key), spaces.Space):
            raise UnsafeFileError(f"does not say its {key}", key)
    n_inputs = get_flattened_obs_dim(settings["observation_space"])
    budget.charge(n_inputs * _BYTES_PER_INPUT)
    for names in (_BUFFER, _ROLLOUT):
        values = [settings.get(name, 1) for name in names]
        if not all(isinstance(value, int) and 0 < value <= MAX_ROWS for value in values):
            raise UnsafeFileError(f"has {' and '.join(names)} out of all proportion", names[0])
        size = math.prod(values) * n_inputs * _FLAT_BYTES
        if size > memory_bytes():
            raise UnsafeFileError(
                f"asks for a buffer of {size:,} bytes, and this machine has {memory_bytes():,}: "
                f"give another {names[0]}",
                names[0],
            )


def check_fit(model: BaseAlgorithm, tensors: Mapping[str, Any]) -> None:
    """Make sure that a model could have written the tensors that it was given."""
    for name in model._get_torch_save_params()[0]:
        part, found = recursive_getattr(model, name), tensors.get(f"{name}.pth", {})
        if isinstance(part, nn.Module):
            for key, like in part.state_dict().items():
                _check_alike(f"{name}.pth: {key}", found[key], like)
        elif isinstance(part, optim.Optimizer):
            _check_optimizer(f"{name}.pth", found, part)


def check_variable(name: str, value: Any) -> None:
    """Make sure that a variable beside the networks is one number."""
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
