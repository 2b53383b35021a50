"""JSON that every reader takes: Python's own writes ``NaN`` and ``Infinity``, which are none."""

from __future__ import annotations

import json
import math
import secrets
from collections.abc import Mapping
from typing import Any

# A number in JSON's grammar, beyond what a double holds: read as infinity, by Python's reader and
# by browsers.
_INFINITY = "1e999"


def plain(value: Any) -> Any:
    """The value as JSON gives it back: NumPy's numbers as Python's, tuples as lists, nan as None.

    Raises:
        TypeError: if there is something else in it.
    """
    match value:
        case Mapping():
            return {_key(key): plain(item) for key, item in value.items()}
        case list() | tuple():
            return [plain(item) for item in value]
        case float():
            return None if math.isnan(value) else float(value)
        case None | bool() | int() | str():
            return value
        case _:
            return plain(_from_numpy(value))


def _from_numpy(value: Any) -> Any:
    import numpy as np  # where there is such a value; `--help` is there without

    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"a {type(value).__name__} has no place in JSON")


def json_text(value: Any, indent: int | None = None) -> str:
    """The value as JSON, with infinity as a number that is too large.

    Raises:
        TypeError: as in `plain`.
    """
    # Nobody can have put these into a text of his.
    tokens = {sign: secrets.token_hex(16) for sign in (math.inf, -math.inf)}
    text = json.dumps(_marked(plain(value), tokens), indent=indent, allow_nan=False)
    for sign, token in tokens.items():
        text = text.replace(f'"{token}"', _INFINITY if sign > 0 else f"-{_INFINITY}")
    return text


def _marked(value: Any, tokens: Mapping[float, str]) -> Any:
    match value:
        case dict():
            return {key: _marked(item, tokens) for key, item in value.items()}
        case list():
            return [_marked(item, tokens) for item in value]
        case float():
            return tokens.get(value, value)
        case _:
            return value


def _key(key: Any) -> str:
    """A name as JSON has it: that of a number or truth value is its text."""
    return key if isinstance(key, str) else json.dumps(plain(key))
