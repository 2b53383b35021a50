"""Containers of classes derived from Python's, made without calling the classes."""

from __future__ import annotations

import random
from collections import deque
from typing import Any

import numpy as np

from snapshots.leaf_filling import MISSING

_CONTAINERS: tuple[Any, ...] = (list, dict, set, random.Random)


def empty_of(kind: type, node: dict[str, Any]) -> Any:
    """An empty container of a class; `MISSING` where its values are needed to make it."""
    for base in _CONTAINERS:
        if issubclass(kind, base):
            return base.__new__(kind)
    if issubclass(kind, deque):
        empty: deque[Any] = deque.__new__(kind)
        deque.__init__(empty, (), node["longest"])
        return empty
    return MISSING


def as_derived(filled: Any, kind: type) -> Any:
    """What was filled, as an array of its own class where it is one."""
    if isinstance(filled, np.ndarray) and issubclass(kind, np.ndarray) and type(filled) is not kind:
        return filled.view(kind)
    return filled
