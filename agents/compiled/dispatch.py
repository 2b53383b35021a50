"""Which function a compiled loop calls: decided by type, while the loop is compiled.

A loop calls ``act(agent, ...)`` or ``step(world, ...)``. Of an environment, the function is the
attribute of that name of the world's class. Of an agent, it is that of the algorithm's class, which
the record of its settings names. So each environment and each algorithm has a loop of its own, in
which nothing is looked up any more, and a new one is a class in a file of its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from numba.core import types
from numba.extending import overload

from agents.common.signatures import CheckedConstructor
from machine_code.cache import RULE_PREFIX
from machine_code.compiling import INLINED_OPTIONS, WITHOUT_WRAPPERS, PartCompiler, is_interpreted

Function = TypeVar("Function", bound=Callable[..., object])

_ALGORITHMS: dict[str, type] = {}
_DEFINITIONS: Counter[str] = Counter()
_NAMES: set[str] = set()


class CompiledOnlyError(TypeError):
    """A function of `by_type` was called from Python, where nothing stands behind it."""


def by_type(stub: Function) -> Function:
    """Make a compiled function that calls its first argument's own function of that name."""
    if is_interpreted():
        raise RuntimeError("agents need Numba's compiler: unset NUMBA_DISABLE_JIT")
    name = stub.__name__
    _NAMES.add(name)

    def choose(thing: Any, *others: Any) -> Any:
        return getattr(getattr(_class_of(thing), name, None), "py_func", None)

    options: Any = {**INLINED_OPTIONS, **WITHOUT_WRAPPERS, "pipeline_class": PartCompiler}
    overload(stub, strict=False, jit_options=options)(choose)
    return stub


def _class_of(argument: Any) -> type | None:
    """The world's class, or the algorithm's that the agent's settings name."""
    # A reference has that of what it refers to.
    argument = getattr(argument, "content", argument)
    if not isinstance(argument, types.BaseNamedTuple):
        return None
    kind: Any = argument
    if "settings" in kind.fields:
        record = kind.types[kind.fields.index("settings")]
        return next((_ALGORITHMS[name] for name in record.fields if name in _ALGORITHMS), None)
    chosen: type = kind.instance_class
    return chosen


class CompiledClass(CheckedConstructor):
    """The class of algorithms; what their loops are compiled from cannot be exchanged."""

    def __setattr__(cls, name: str, value: object) -> None:  # noqa: N805  # of a metaclass
        if name in _NAMES:
            raise AttributeError(
                f"{cls.__name__}.{name} is compiled into its loop: define a subclass with another"
            )
        super().__setattr__(name, value)


def check_functions(algorithm: type) -> None:
    """Make sure that what the compiled loop calls of an algorithm is compiled.

    Raises:
        TypeError: naming the function that is not, and what to do.
    """
    for name in _NAMES & vars(algorithm).keys():
        if not hasattr(vars(algorithm)[name], "py_func"):
            raise TypeError(
                f"{algorithm.__name__}.{name} is called by compiled code: put @inlined of "
                "machine_code.compiling on the function"
            )


def settings_dtype(algorithm: type, fields: Mapping[str, Any]) -> np.dtype[np.void]:
    """The type of the record that holds an algorithm's settings.

    Args:
        algorithm: the class.
        fields: types of the settings by their names, which are those of the agent's attributes.
    """
    name = f"{RULE_PREFIX}{algorithm.__module__} {algorithm.__qualname__}"
    _DEFINITIONS[name] += 1
    if _DEFINITIONS[name] > 1:
        # Defined anew, as in a notebook: what was compiled for the old one must not run.
        name = f"{name} {_DEFINITIONS[name]}"
    _ALGORITHMS[name] = algorithm
    return np.dtype([(name, np.uint8), *fields.items()], align=True)
