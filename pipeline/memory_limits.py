"""What settings ask for, held against the memory that there is, before any of it is taken.

The figures are estimates from below: what is refused here could not have been trained.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any

from gymnasium import spaces

from pipeline.errors import UserError
from pipeline.settings.hyperparams import Hyperparams
from safe_files.files import memory_bytes

_BYTES_PER_ENVIRONMENT = 20_000  # CartPole with its Monitor takes more
_BYTES_PER_WEIGHT = 16  # of 32 bits, with its gradient and two moments of Adam
_BYTES_PER_PULL = 24  # the arm, the reward and the regret
_BYTES_PER_RECORDED_STEP = 32  # state, action, reward and probability

# What counts observations among the arguments of an agent's constructor.
_BUFFERS = frozenset({"buffer_size", "n_steps", "n_delta", "longest_episode"})


def observation_bytes(space: spaces.Space[Any]) -> int:
    """Bytes of one observation; 0 where the space does not tell."""
    if isinstance(space, spaces.Dict):
        return sum(map(observation_bytes, space.spaces.values()))
    if isinstance(space, spaces.Tuple):
        return sum(map(observation_bytes, space.spaces))
    if space.shape is None or space.dtype is None:
        return 0
    return math.prod(space.shape) * space.dtype.itemsize


def check_environments(n_envs: int, where: str) -> None:
    """Refuse more environments than the memory holds.

    Args:
        n_envs: how many are to be made.
        where: begins the error message.

    Raises:
        UserError: naming the number, what it takes, and what there is.
    """
    _check(f"n_envs {n_envs:,}", n_envs * _BYTES_PER_ENVIRONMENT, where)


def check_frame_stack(
    n_frames: int, n_envs: int, observations: spaces.Space[Any], where: str
) -> None:
    """Refuse stacks of observations that the memory does not hold; see `check_environments`."""
    n_bytes = n_frames * n_envs * observation_bytes(observations)
    _check(f"frame_stack {n_frames:,} with n_envs {n_envs:,}", n_bytes, where)


def check_pulls(n_runs: int, n_timesteps: int, where: str) -> None:
    """Refuse a batch of bandit runs whose pulls the memory does not hold."""
    n_bytes = n_runs * n_timesteps * _BYTES_PER_PULL
    _check(f"{n_runs:,} seeds with n_timesteps {n_timesteps:,}", n_bytes, where)


def takes_buffers(special: Hyperparams, parameters: Iterable[str]) -> bool:
    """Whether the memory that an agent takes depends on the size of an observation."""
    return special.frame_stack is not None or not _BUFFERS.isdisjoint(parameters)


def check_agent(
    special: Hyperparams,
    arguments: Mapping[str, Any],
    observations: spaces.Space[Any] | None,
    where: str,
) -> None:
    """Refuse an agent whose environments, buffers or networks the memory does not hold.

    Args:
        special: the settings of the run.
        arguments: of the agent's constructor, with the defaults of those that are not given.
        observations: space of one environment, before its observations are stacked; None where
            they do not matter, see `takes_buffers`.
        where: begins the error message.

    Raises:
        UserError: naming the setting, what it takes, and what there is.
    """
    check_environments(special.n_envs, where)
    if observations is not None:
        _check_buffers(special, arguments, observations, where)
    policy = arguments.get("policy_kwargs")
    if isinstance(policy, Mapping):
        n_bytes = _policy_weights(policy) * _BYTES_PER_WEIGHT
        _check("the network of policy_kwargs", n_bytes, where)


def _check_buffers(
    special: Hyperparams,
    arguments: Mapping[str, Any],
    observations: spaces.Space[Any],
    where: str,
) -> None:
    n_envs, n_frames = special.n_envs, special.frame_stack or 1
    check_frame_stack(n_frames, n_envs, observations, where)
    # The least that a transition holds, besides what is seen.
    stored = n_frames * observation_bytes(observations) + 8
    copies = 1 if arguments.get("optimize_memory_usage") is True else 2
    asked = {
        "buffer_size": (1, copies * stored),
        "n_steps": (n_envs, stored),
        "n_delta": (1, stored),
        "longest_episode": (n_envs, _BYTES_PER_RECORDED_STEP),
        "batch_size": (1, stored if _number(arguments.get("buffer_size")) else 0),
    }
    for name, (times, n_bytes) in asked.items():
        number = _number(arguments.get(name))
        beside = f" with n_envs {times:,}" if times > 1 else ""
        _check(f"{name} {number:,}{beside}", number * times * n_bytes, where)


def _number(value: object) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) else 0


def _policy_weights(policy: Mapping[str, Any]) -> int:
    """Weights of a network at least, and the pairs of quantiles that its loss compares."""
    memory_cells = _number(policy.get("lstm_hidden_size", 256))
    return (
        max(_weights(policy.get("net_arch")), 100) * _number(policy.get("n_critics", 1))
        + 4 * memory_cells**2 * _number(policy.get("n_lstm_layers", 1))
        + _number(policy.get("n_quantiles")) ** 2
    )


def _weights(layers: object) -> int:
    """Weights between the layers of a ``net_arch``, which may nest lists and mappings of them."""
    if isinstance(layers, Mapping):
        return sum(map(_weights, layers.values()))
    if not isinstance(layers, Iterable) or isinstance(layers, str):
        return 0
    layers = list(layers)
    sizes = [1, *filter(None, map(_number, layers)), 1]
    # And a bias for each.
    between = sum((before + 1) * size for before, size in pairwise(sizes))
    return between + sum(map(_weights, layers))


def _check(what: str, n_bytes: int, where: str) -> None:
    present = memory_bytes()
    if n_bytes > present:
        raise UserError(
            f"{where}: {what} would take {_gigabytes(n_bytes)} of memory at least, "
            f"and this machine has {_gigabytes(present)}"
        )


def _gigabytes(n_bytes: int) -> str:
    return f"{max(round(n_bytes / 2**30), 1):,} GB"
