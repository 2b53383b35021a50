"""Functions with what they have closed over, and methods with their objects.

Code is never kept: a function is the one that is there, or one that has the name.
"""

from __future__ import annotations

import hashlib
import inspect
from types import FunctionType, MethodType
from typing import Any

from snapshots.kinds import find, name_of


def is_callable_of_ours(value: Any) -> bool:
    """Whether a value is a method of an object, or a function that could be taken for another."""
    if isinstance(value, MethodType):
        return _method_of(value.__self__, value.__func__.__name__) is value.__func__
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


def fill_method(name: str, owner: Any, existing: Any) -> Any:
    """The method of that name of an object; the existing one, where it is that."""
    function = _method_of(owner, name)
    is_method = isinstance(existing, MethodType) and existing.__self__ is owner
    if is_method and existing.__func__ is function:
        return existing
    return MethodType(function, owner) if isinstance(function, FunctionType) else existing


def _method_of(owner: Any, name: str) -> Any:
    """The function of a method, without calling anything of the object's."""
    found = inspect.getattr_static(type(owner), name, None)
    return found if isinstance(found, FunctionType) else None
