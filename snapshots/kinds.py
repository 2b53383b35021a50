"""What a value is to a snapshot: data, a holder of data, code that stays, or none of these."""

from __future__ import annotations

import functools
import io
import operator
import sys
import threading
import types
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th

# Attributes that belong to one process, or to one moment; by the names of the classes.
_LEFT_OUT = {
    "stable_baselines3.common.callbacks.BaseCallback": ("locals", "globals"),
    "stable_baselines3.common.vec_env.base_vec_env.VecEnvWrapper": ("class_attributes",),
}

_LOCKS = (type(threading.Lock()), type(threading.RLock()))

# What stays as it was built: code, and what belongs to the process rather than to the state.
_CONSTANT_TYPES = (
    type,
    types.FunctionType,
    types.BuiltinFunctionType,
    functools._lru_cache_wrapper,
    operator.attrgetter,
    types.MethodType,
    types.MethodWrapperType,
    types.MethodDescriptorType,
    types.WrapperDescriptorType,
    types.ModuleType,
    types.MappingProxyType,
    types.GenericAlias,
    property,
    staticmethod,
    classmethod,
    threading.Thread,
    weakref.ref,
    types.NotImplementedType,
    np.ufunc,
    type(np.mean),
    th.layout,
    *_LOCKS,
)
# Compiled functions, windows and their clocks, bars, writers of rows: made anew when needed.
_CONSTANT_MODULES = (
    "numba",
    "llvmlite",
    "pygame",
    "_csv",
    "moviepy",
    "tensorboard",
    "rich",
    "tqdm",
    "typing",
)
# Among these is what holds data: it cannot be copied, and must not be taken for code.
_HOLDING = ("numba.typed", "numba.experimental", "_csv.reader")
# What stands for something outside of this process, of which nothing can be copied.
_OUTSIDE = (
    "subprocess.Popen",
    "multiprocessing.process.BaseProcess",
    "multiprocessing.connection._ConnectionBase",
    "tempfile.TemporaryDirectory",
)
_GAME_DATA = ("Rect", "FRect", "Vector2", "Vector3", "Color", "Mask", "PixelArray", "BufferProxy")

# What a network said last: made anew before it is looked at again.
TRANSIENT_TYPES = (th.distributions.Distribution,)

_POINTER = 8  # bytes


class NotRecordableError(Exception):
    """An object holds what a snapshot cannot keep.

    Attributes:
        place: where it is, as ``model.env.envs[0].world``.
        reason: why.
    """

    def __init__(self, place: str, reason: str) -> None:
        super().__init__(f"{place}: {reason}")
        self.place, self.reason = place, reason


def is_constant(value: Any, more: tuple[type, ...] = ()) -> bool:
    """Whether a value stays as it was built.

    Args:
        value: any.
        more: further types of which that is so.
    """
    kind = type(value)
    if f"{kind.__module__}.{kind.__name__}".startswith(_HOLDING):
        return False
    if isinstance(value, io.IOBase):
        return value.closed or value in (sys.stdin, sys.__stdin__) or not value.readable()
    top = kind.__module__.partition(".")[0]
    if top == "pygame" and (kind.__name__ in _GAME_DATA or not hides_state(kind)):
        return False
    return isinstance(value, (*_CONSTANT_TYPES, *more)) or top in _CONSTANT_MODULES


def likeness(value: Any) -> str:
    """What has to be in the place of a constant that is found there; empty for anything.

    Windows and what is compiled are made anew when they are needed, and may not be there yet.
    """
    if not isinstance(value, (io.IOBase, *_CONSTANT_TYPES)) or getattr(value, "closed", False):
        return ""
    return f"{name_of(type(value))} {getattr(value, '__name__', '')}"


def has_cached(value: Any) -> bool:
    """Whether a value is a function of `functools.lru_cache` that remembers something."""
    return isinstance(value, functools._lru_cache_wrapper) and value.cache_info().currsize > 0


def keeps_order(values: set[Any] | frozenset[Any]) -> bool:
    """Whether a set that is made of the same values runs through them in the same order.

    What was taken away leaves gaps, by which the rest is ordered. Of texts each process has an
    order of its own, so that no run goes by it.
    """
    order = list(values)
    if not all(isinstance(value, int | float | tuple) for value in order):
        return True
    again = set(order)
    return list(again) == order and sys.getsizeof(again) == sys.getsizeof(values)


def is_transient(value: Any) -> bool:
    """Whether a value is not needed any more at the moments at which states are taken."""
    return isinstance(value, TRANSIENT_TYPES)


def left_out(kind: type) -> frozenset[str]:
    """Names of the attributes of a class that no snapshot keeps.

    A class names its own in an attribute ``not_in_snapshots``.
    """
    names: set[str] = set()
    for base in kind.__mro__:
        names.update(_LEFT_OUT.get(f"{base.__module__}.{base.__qualname__}", ()))
        names.update(vars(base).get("not_in_snapshots", ()))
    return frozenset(names)


def slots(kind: type) -> Iterator[str]:
    """The names of the slots of a class and those above it, as attributes are called."""
    for base in kind.__mro__:
        declared = vars(base).get("__slots__", ())
        for name in [declared] if isinstance(declared, str) else declared:
            if name in ("__dict__", "__weakref__"):
                continue
            private = name.startswith("__") and not name.endswith("__")
            yield f"_{base.__name__.lstrip('_')}{name}" if private else name


def hides_state(kind: type) -> bool:
    """Whether objects of a class hold more than attributes, as those written in C do."""
    if any(f"{base.__module__}.{base.__qualname__}" in _OUTSIDE for base in kind.__mro__):
        return True
    declares_slots = any("__slots__" in vars(base) for base in kind.__mro__)
    if kind is not object and not kind.__dictoffset__ and not declares_slots:
        return True  # no class of Python's has nowhere to put its attributes
    # An object's head, its attributes' dictionary and its weak references, and a pointer a slot.
    plain = object.__basicsize__ + 2 * _POINTER + _POINTER * sum(1 for _ in slots(kind))
    return kind.__itemsize__ > 0 or kind.__basicsize__ > plain


def name_of(value: Any) -> str:
    """Module and qualified name of a class or a function; empty where it has none."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    return f"{module}:{name}" if isinstance(module, str) and isinstance(name, str) else ""


def find(name: str) -> Any:
    """The class or function of that name, in a module that is there already; None if there is none.

    Args:
        name: as `name_of` has it.
    """
    module, _, path = name.partition(":")
    found: Any = sys.modules.get(module)
    for part in path.split("."):
        found = getattr(found, part, None)
    return found if name_of(found) == name else None
