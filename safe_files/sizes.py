"""Whether what a model's settings ask for is in proportion to its file.

The library makes the networks that the settings describe before it looks at the weights, and the
buffers too: a file of some bytes could ask for all the memory that there is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from torch.overrides import TorchFunctionMode

from safe_files.limits import MAX_ROWS, Budget, memory_bytes
from safe_files.refusals import UnsafeFileError

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


class charged_tensors(TorchFunctionMode):  # noqa: N801  # it is used as a function is
    """While it is entered, the budget pays for tensors before they are made.

    Args:
        budget: that of the file whose settings say what is made.
    """

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
    """Make sure that the settings say their spaces, and that their buffers fit the memory.

    Args:
        settings: the model's attributes.
        budget: pays for an observation.

    Raises:
        UnsafeFileError: if they do not.
    """
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
