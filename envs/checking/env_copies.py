"""Environments to try things on, so that the caller's own stay as they are."""

from __future__ import annotations

import copy
import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np

Env = gym.Env[Any, Any]


def copy_of(base: Env) -> Env:
    """An environment like this one, which draws nothing on the screen.

    It is a deep copy. Where that cannot be had (an open window, a file), another one is made as
    `gymnasium.make` made this one, and what was changed by hand since then is not in it.

    Args:
        base: an environment without wrappers.

    Raises:
        ValueError: if neither works, or if ``step`` or ``reset`` of this very object was replaced:
            that of a copy may well act on the original.
    """
    for name in ("step", "reset"):
        if name in vars(base):
            raise ValueError(f"its {name} was replaced by hand, and cannot be tried on a copy")
    try:
        twin = copy.deepcopy(base)
    except Exception as error:  # noqa: BLE001  # whatever it is that cannot be copied
        twin = _made_anew(base, error)
    if twin.render_mode is not None:
        vars(twin)["render_mode"] = None
    return twin


def _made_anew(base: Env, reason: Exception) -> Env:
    if base.spec is None:
        raise ValueError(f"it cannot be copied ({_one_line(reason)})") from reason
    try:
        return gym.make(base.spec, render_mode=None).unwrapped
    except Exception as error:
        text = f"it can neither be copied ({_one_line(reason)}) nor made anew ({_one_line(error)})"
        raise ValueError(text) from error


@contextmanager
def global_generators_apart(seed: int) -> Iterator[None]:
    """Within, the generators that all code shares start from a seed; afterwards they are as before.

    Environments should not draw from them. Some do.
    """
    kept = random.getstate(), np.random.get_state()  # noqa: NPY002  # not to draw from it
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(kept[0])
        np.random.set_state(kept[1])  # noqa: NPY002


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
