"""Refuses nan and infinity before an agent learns from them or is evaluated by them.

Infinity is refused like nan, also in an observation space without bounds: the first update of a
network turns infinity into nan, and so does the first difference from a mean that contains it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import isfinite
from typing import Any

import numpy as np
import torch as th
from numpy import vdot
from numpy.typing import NDArray

from rl_yardstick.agents.bandits.tables import BanditPolicy
from rl_yardstick.pipeline.errors import UserError

# Single and double precision, whose scalar products BLAS computes.
_FAST = frozenset("fd")
_FAST_TENSORS = frozenset({th.float32, th.float64})
_WHOLE = frozenset("?bBhHiIlLqQ")


class NotFiniteError(UserError):
    """A number is nan or infinite where it must be finite."""

    def __init__(self, place: str, value: float) -> None:
        super().__init__(f"{place} is {value}")


def is_finite(values: Any) -> bool:
    """Whether all numbers of an array or a mapping of arrays are finite; fast, for every step."""
    if type(values) is not np.ndarray:
        return values is None or all(is_finite(array) for _, array in _parts(values))
    kind = values.dtype.char
    if kind in _FAST:
        # One call instead of two with a temporary array; it also overflows for large finite values.
        return isfinite(vdot(values, values)) or bool(np.isfinite(values).all())
    return kind in _WHOLE or bool(np.isfinite(values).all())


def check_numbers(values: Any, what: str, when: str) -> None:
    """Check that all numbers of an array or a mapping of arrays are finite; None passes."""
    for name, array in _parts(values):
        if not is_finite(array):
            raise NotFiniteError(f"{what}{name} {when}", _culprit(array))


def check_rows(values: Any, what: str, when: str) -> None:
    """Like `check_numbers`, for values with a row for each environment, shape (n_envs, ...)."""
    for name, array in _parts(values):
        if not is_finite(array):
            rows = np.isfinite(array).reshape(len(array), -1).all(axis=1)
            i = int(np.argmin(rows))
            raise NotFiniteError(f"{what}{name} of environment {i} {when}", _culprit(array[i]))


def check_model(model: Any) -> None:
    """Check that an agent's tables or weights and its statistics are finite."""
    when = f"at step {model.num_timesteps:,}"
    policy = getattr(model, "policy", None)
    if isinstance(policy, th.nn.Module):
        for name, table in policy.state_dict().items():
            # An infinite score marks an arm that was never pulled.
            is_scores = name == "scores" and isinstance(policy, BanditPolicy)
            tensor = table[policy.get_buffer("counts") > 0] if is_scores else table
            if not _is_finite_tensor(tensor):
                values = tensor.detach().cpu().double().numpy()
                raise NotFiniteError(f"a value in {name} of the agent {when}", _culprit(values))
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        for name in ("obs_rms", "ret_rms"):
            statistics = getattr(normalization, name, None)
            parts = statistics if isinstance(statistics, dict) else {"": statistics}
            for key, part in parts.items():
                if part is not None:
                    what = f"{name} of VecNormalize{f' ({key})' if key else ''}"
                    check_numbers({"mean": part.mean, "variance": part.var}, what, when)


def _is_finite_tensor(tensor: th.Tensor) -> bool:
    if tensor.dtype in _FAST_TENSORS:
        return is_finite(tensor.detach().cpu().numpy())
    return not tensor.is_floating_point() or bool(th.isfinite(tensor).all())


def _parts(values: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """The arrays among values, each with its name for messages."""
    if isinstance(values, Mapping):
        for name, array in values.items():
            yield f" {name!r}", np.asarray(array)
    elif values is not None:
        yield "", np.asarray(values)


def _culprit(values: NDArray[Any]) -> float:
    """Find the first number that is not finite."""
    flat = np.ravel(values)
    return float(np.real(flat[np.argmin(np.isfinite(flat))]))
