"""Functions with what they have closed over, and methods with their objects.

Code is never kept: a function is the one that is there, or one that has the name.
"""

from __future__ import annotations

import hashlib
import inspect
from types import (
    BuiltinFunctionType,
    FunctionType,
    MethodDescriptorType,
    MethodType,
    MethodWrapperType,
    ModuleType,
    WrapperDescriptorType,
)
from typing import Any

import numpy as np

from snapshots.kinds import find, name_of

# Functions of classes that are written in C, whose methods keep their objects as others do.
_COMPILED = (MethodDescriptorType, WrapperDescriptorType, type(np.random.Generator.random))
METHODS = (MethodType, BuiltinFunctionType, MethodWrapperType)


def is_callable_of_ours(value: Any) -> bool:
    """Whether a value is a method of an object, or a function that could be taken for another."""
    if isinstance(value, METHODS):
        owner = value.__self__
        is_bound = owner is not None and not isinstance(owner, type | ModuleType)
        return is_bound and _method_of(owner, name_in_class(value)) == value
    if not isinstance(value, FunctionType):
        return False
    try:
        contents = [cell.cell_contents for cell in value.__closure__ or ()]
    except ValueError:  # one that is empty still
        return False
    return bool(contents) or "<" in value.__qualname__


def code_of(function: FunctionType) -> str:
    """What tells functions of one name apart, as lambdas are."""
    code = function.__code__
    constants = [held for held in code.co_consts if isinstance(held, int | float | str | None)]
    return hashlib.sha256(repr((code.co_code, code.co_names, constants)).encode()).hexdigest()


def fill_function(node: dict[str, Any], existing: Any) -> FunctionType:
    """The function that a node tells of.

    Raises:
        LookupError: if it is not there.
    """
    for found in (existing, find(node["class"])):
        if not isinstance(found, FunctionType) or name_of(found) != node["class"]:
            continue
        if code_of(found) == node["code"] and len(found.__closure__ or ()) == len(node["items"]):
            return found
    raise LookupError(f"the function {node['class']}")


def name_in_class(method: Any) -> str:
    """The name of a method's function."""
    name: str = getattr(method, "__func__", method).__name__
    return name


def fill_method(name: str, owner: Any, existing: Any) -> Any:
    """The method of that name of an object; the existing one, where it is that.

    Raises:
        LookupError: if its class has none.
    """
    method = _method_of(owner, name)
    if method is None:
        raise LookupError(f"the method {name}")
    return existing if existing == method else method


def _method_of(owner: Any, name: str) -> Any:
    """A method of an object, without calling anything of the user's; None if there is none."""
    found = inspect.getattr_static(type(owner), name, None)
    if isinstance(found, FunctionType):
        return MethodType(found, owner)
    return found.__get__(owner) if isinstance(found, _COMPILED) else None
