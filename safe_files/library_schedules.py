"""Schedules in pickles: the library's own, rl_zoo3's, and those that older versions wrote as code.

Up to version 2.6 Stable-Baselines3 had no classes for schedules: a model holds functions, code and
all. The code is not looked at. Which of the known functions it was is said by its name, and the
numbers that it was made with stand beside it: that makes the schedule of today that is its equal.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from torch.distributions.transforms import AffineTransform, ComposeTransform, ExpTransform

from safe_files.pickle_trees import Made, Name
from safe_files.rebuilding import Build, Maker, fields, wrong
from safe_files.refusals import UnsafeFileError, shown

_UTILS = "stable_baselines3.common.utils"
_TRANSFORMS = "torch.distributions.transforms"
_Schedule = Callable[[float], float]


def proportional(initial_value: float) -> _Schedule:
    """What falls from ``initial_value`` to 0 in proportion to the progress remaining.

    It is made of Python's own parts, so that a zip that holds it opens wherever Python does.
    """
    return partial(operator.mul, initial_value)


def _constant(made: Made, build: Build) -> ConstantSchedule:
    return ConstantSchedule(*_numbers(made, build, "val"))


def _linear(made: Made, build: Build) -> LinearSchedule:
    return LinearSchedule(*_numbers(made, build, "start", "end", "end_fraction"))


def _simple_linear(made: Made, build: Build) -> _Schedule:
    return proportional(*_numbers(made, build, "initial_value"))


def _float_schedule(made: Made, build: Build) -> FloatSchedule:
    state = fields(made, build)
    inner = state.get("value_schedule")
    if set(state) != {"value_schedule"} or not callable(inner) or isinstance(inner, type):
        raise wrong(made)
    return FloatSchedule(inner)


def _partial(made: Made, build: Build) -> _Schedule:
    """What `proportional` returns, once it was saved; any other partial is refused."""
    state = made.state
    function, *_ = made.args or (None,)
    if not (isinstance(function, Name) and str(function) == "functools.partial"):
        raise wrong(made)
    if not (isinstance(state, tuple) and len(state) == 4):
        raise wrong(made)
    inner, args, *_ = state
    if not (isinstance(inner, Name) and str(inner) == "_operator.mul" and len(args) == 1):
        raise wrong(made)
    return proportional(_number(build(args[0]), made))


def _numbers(made: Made, build: Build, *names: str) -> list[float]:
    state = fields(made, build)
    if set(state) != set(names):
        raise wrong(made)
    return [_number(state[name], made) for name in names]


def _number(value: Any, made: Made) -> float:
    # As it is, not made a float: a schedule of whole numbers stays one.
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise wrong(made)
    return value


def _exponent(made: Made, build: Build) -> ExpTransform:
    _transform_state(made, build)
    return ExpTransform()


def _affine(made: Made, build: Build) -> AffineTransform:
    state = _transform_state(made, build, "loc", "scale", "_event_dim")
    loc, scale = (_finite(state[name], made) for name in ("loc", "scale"))
    if state["_event_dim"] != 0:
        raise wrong(made)
    return AffineTransform(loc, scale)


def _composed(made: Made, build: Build) -> ComposeTransform:
    """One transform after another: a schedule made of PyTorch's parts, such as exp(a + b x)."""
    parts = _transform_state(made, build, "parts")["parts"]
    kinds = ComposeTransform | AffineTransform | ExpTransform
    if not isinstance(parts, list) or not all(isinstance(part, kinds) for part in parts):
        raise wrong(made)
    return ComposeTransform(parts)


def _transform_state(made: Made, build: Build, *names: str) -> Mapping[str, Any]:
    state = fields(made, build)
    if set(state) != {"_cache_size", "_inv", *names} or state["_cache_size"] or state["_inv"]:
        raise wrong(made)
    return state


def _finite(value: Any, made: Made) -> Any:
    """A number, or a tensor of them."""
    if not isinstance(value, th.Tensor):
        return _number(value, made)
    if not bool(th.isfinite(value).all()):
        raise wrong(made)
    return value


# Functions that made schedules, by module and qualified name: how what they enclosed makes one.
_ENCLOSING: Mapping[tuple[str, str], Callable[..., _Schedule]] = {
    (_UTILS, "constant_fn.<locals>.func"): ConstantSchedule,
    (_UTILS, "get_linear_fn.<locals>.func"): LinearSchedule,
    (_UTILS, "get_schedule_fn.<locals>.<lambda>"): FloatSchedule,
    ("rl_zoo3.utils", "linear_schedule.<locals>.func"): proportional,
}


def _function(made: Made, build: Build) -> _Schedule:
    """A function that was pickled with its code: one of the known ones, or refused."""
    module, qualname, enclosed = _enclosed(made)
    make = _ENCLOSING.get((module, qualname))
    if make is None:
        raise UnsafeFileError(f"holds a function with its code, {shown(qualname)}")
    values = {name: build(value) for name, value in enclosed.items()}
    for value in values.values():
        if not callable(value):
            _number(value, made)
    return make(**values)


def _enclosed(made: Made) -> tuple[str, str, dict[str, Any]]:
    """Module and name of a function, and the values that it encloses, by their names there."""
    try:
        _, slots = made.state
        attributes = dict(slots)
        # The names end the arguments of the code object, but for those of its own cells.
        names = made.args[0].args[-2]
        cells = attributes["__closure__"]
        values = [cell.args[0] for cell in cells]
        enclosed = dict(zip(names, values, strict=True))
        return str(attributes["__module__"]), str(attributes["__qualname__"]), enclosed
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UnsafeFileError("holds a function with its code") from error


MAKERS: Mapping[str, Maker] = {
    f"{_UTILS}.ConstantSchedule": _constant,
    f"{_UTILS}.LinearSchedule": _linear,
    f"{_UTILS}.FloatSchedule": _float_schedule,
    f"{_TRANSFORMS}.ExpTransform": _exponent,
    f"{_TRANSFORMS}.AffineTransform": _affine,
    f"{_TRANSFORMS}.ComposeTransform": _composed,
    "rl_zoo3.utils.SimpleLinearSchedule": _simple_linear,
    "functools.partial": _partial,
    "cloudpickle.cloudpickle._make_function": _function,
}
