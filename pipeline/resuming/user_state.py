"""What the user's own modules keep outside of objects: in global names, and in classes."""

from __future__ import annotations

import enum
import functools
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from pipeline.user_modules import UserModule

_CODE = (ModuleType, type, FunctionType)


def user_state(modules: Iterable[UserModule]) -> dict[str, dict[str, Any]]:
    """The values of global names and of classes' attributes, by the names of their holders.

    Args:
        modules: those that were typed; what lies beside them counts too, what is installed does
            not.
    """
    return {name: _values(holder) for name, holder in _holders(modules)}


def put_back(modules: Iterable[UserModule], state: Mapping[str, Mapping[str, Any]]) -> None:
    """Let the names have those values."""
    for name, holder in _holders(modules):
        before = _values(holder)
        for attribute, value in state.get(name, {}).items():
            if attribute not in before or before[attribute] is not value:
                setattr(holder, attribute, value)


def _holders(modules: Iterable[UserModule]) -> Iterator[tuple[str, ModuleType | type]]:
    typed = [module for module in modules if module.path is not None]
    if not typed:
        return
    for name, module in list(sys.modules.items()):
        if not any(_is_of(module, name, user) for user in typed):
            continue
        yield name, module
        for held in list(vars(module).values()):
            is_own = isinstance(held, type) and held.__module__ == name
            if is_own and not issubclass(held, enum.Enum):
                yield f"{name}:{held.__qualname__}", held


def _is_of(module: ModuleType, name: str, user: UserModule) -> bool:
    """Whether a module is the user's: the one that was typed, part of it, or a file beside it."""
    top = user.name.partition(".")[0]
    if name == top or name.startswith(f"{top}."):
        return True
    file, folder = getattr(module, "__file__", None), Path(user.path or "").parent
    ours = Path(__file__).resolve().parents[2]
    return bool(file) and Path(str(file)).parent == folder and folder != ours


def _is_method(value: Any) -> bool:
    """Whether a class's attribute is a method or the like, but for those that remember."""
    return hasattr(type(value), "__get__") and not isinstance(value, functools._lru_cache_wrapper)


def _values(holder: ModuleType | type) -> dict[str, Any]:
    """What is data of it: no code, and nothing that Python keeps there itself."""
    return {
        name: value
        for name, value in vars(holder).items()
        if not name.startswith(("__", "_abc_"))
        and not isinstance(value, _CODE)
        and not (isinstance(holder, type) and _is_method(value))
    }
