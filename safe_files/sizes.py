"""Whether what a model's settings ask for is in proportion to what its file holds.

The library makes the networks that the settings describe before it looks at the weights, and the
buffers too: a file of some bytes could ask for all the memory that there is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim

from safe_files.limits import MAX_ROWS, MAX_WIDTH, memory_bytes
from safe_files.refusals import UnsafeFileError
from safe_files.tensors import tensors_in

# Attributes that say how many rows a buffer has; they multiply where there are several.
_BUFFER = ("buffer_size",)
_ROLLOUT = ("n_steps", "n_envs")
_FLAT_BYTES = 4
_NETWORKS = "asks for networks that are out of proportion to its weights"


def check_sizes(settings: Mapping[str, Any], tensors: Mapping[str, Any]) -> None:
    """Make sure that the model fits the memory, and its networks the weights in the file.

    Args:
        settings: the model's attributes.
        tensors: what its files of tensors hold.

    Raises:
        UnsafeFileError: if they do not.
    """
    n_weights = sum(tensor.numel() for _, tensor in tensors_in(tensors))
    for key in ("observation_space", "action_space"):
        if not isinstance(settings.get(key), spaces.Space):
            raise UnsafeFileError(f"does not say its {key}", key)
    n_inputs = get_flattened_obs_dim(settings["observation_space"])
    _check_networks(settings, n_weights, n_inputs)
    _check_buffers(settings, n_inputs)


def _check_networks(settings: Mapping[str, Any], n_weights: int, n_inputs: int) -> None:
    # Each input has a weight, and each unit one for each unit before it.
    largest = max(n_weights, MAX_WIDTH)
    actions = settings["action_space"]
    if n_inputs > largest or (isinstance(actions, spaces.Discrete) and actions.n > largest):
        raise UnsafeFileError("has spaces that are out of proportion to its weights")
    policy_kwargs = settings.get("policy_kwargs")
    numbers = list(_numbers(policy_kwargs, 0))
    products = (a * b for a, b in pairwise(numbers))
    if max(products, default=0) > largest or max(numbers, default=0) > largest:
        raise UnsafeFileError(_NETWORKS, "policy_kwargs")
    if len(numbers) > MAX_WIDTH:
        raise UnsafeFileError(_NETWORKS, "policy_kwargs")


def _numbers(value: Any, depth: int) -> Iterator[int]:
    """The whole numbers in nested settings, in their order."""
    if isinstance(value, int) and not isinstance(value, bool):
        yield abs(value)
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _numbers(inner, depth + 1)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _numbers(inner, depth + 1)


def _check_buffers(settings: Mapping[str, Any], n_inputs: int) -> None:
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
