"""Gymnasium's spaces in pickles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from safe_files.pickle_trees import Made
from safe_files.rebuilding import Build, Maker, fields

# Beyond this no table or network has an input.
_MAX_SIZE = 10_000_000

_Space = spaces.Space[Any]


def _box(state: Mapping[str, Any]) -> _Space:
    low, high = np.asarray(state["low"]), np.asarray(state["high"])
    return spaces.Box(low, high, dtype=state["dtype"].type)


def _discrete(state: Mapping[str, Any]) -> _Space:
    n, start = int(state["n"]), int(state.get("start", 0))
    if not 0 < n <= _MAX_SIZE:
        raise ValueError("too many values")
    dtype = state.get("dtype")
    return spaces.Discrete(n, start=start, **({} if dtype is None else {"dtype": dtype.type}))


def _multi_discrete(state: Mapping[str, Any]) -> _Space:
    counts = np.asarray(state["nvec"])
    if counts.sum() > _MAX_SIZE:
        raise ValueError("too many values")
    start = state.get("start")
    return spaces.MultiDiscrete(counts, dtype=state["dtype"].type, start=start)


def _multi_binary(state: Mapping[str, Any]) -> _Space:
    n = state["n"]
    shape = n if isinstance(n, tuple) else (int(n),)
    if np.prod(shape, dtype=float) > _MAX_SIZE:
        raise ValueError("too many values")
    return spaces.MultiBinary(n)


def _tuple(state: Mapping[str, Any]) -> _Space:
    return spaces.Tuple(tuple(state["spaces"]))


def _dict(state: Mapping[str, Any]) -> _Space:
    return spaces.Dict(dict(state["spaces"]))


def _maker(make: Callable[[Mapping[str, Any]], _Space]) -> Maker:
    def maker(made: Made, build: Build) -> _Space:
        state = fields(made, build)
        space = make(state)
        generator = state.get("_np_random")
        if isinstance(generator, np.random.Generator):
            # Whoever goes on with the model draws on from where it was.
            space._np_random = generator
        return space

    return maker


MAKERS: Mapping[str, Maker] = {
    "gymnasium.spaces.box.Box": _maker(_box),
    "gymnasium.spaces.discrete.Discrete": _maker(_discrete),
    "gymnasium.spaces.multi_discrete.MultiDiscrete": _maker(_multi_discrete),
    "gymnasium.spaces.multi_binary.MultiBinary": _maker(_multi_binary),
    "gymnasium.spaces.tuple.Tuple": _maker(_tuple),
    "gymnasium.spaces.dict.Dict": _maker(_dict),
}
