"""Mistakes of the user's, and how messages name them."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable

_SHORT_LIST = 12

_brief = reprlib.Repr()
_brief.maxstring = _brief.maxother = 60


class UserError(Exception):
    """A mistake of the user's: one line that says what is wrong, where, and what would be right."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(line.strip() for line in message.splitlines()))


def shown(value: object) -> str:
    """The value as an error message quotes it, shortened where it is long."""
    return _brief.repr(value)


def did_you_mean(name: str, known: Iterable[str], n: int = 1) -> str:
    """A hint at what ``name`` was meant to be.

    Args:
        name: what the user wrote.
        known: what could have been written.
        n: how many of the nearest names to offer.

    Returns:
        The nearest names as a question; all names where none is near and the list is short; else
        nothing.
    """
    known = list(dict.fromkeys(known))
    by_lower_case = {option.lower(): option for option in known}
    near = [
        by_lower_case[match] for match in difflib.get_close_matches(name.lower(), by_lower_case, n)
    ]
    if near:
        return f"did you mean {' or '.join(map(repr, near))}?"
    if 0 < len(known) <= _SHORT_LIST:
        return f"known are {', '.join(known)}"
    return ""


def unknown(what: str, name: str, known: Iterable[str], n: int = 1) -> UserError:
    """The error for a ``name`` that is not among ``known``: "{what} 'name': did you mean ...?"."""
    hint = did_you_mean(name, known, n)
    return UserError(f"{what} {shown(name)}" + (f": {hint}" if hint else ""))


def one_line(error: BaseException) -> str:
    """The message of a foreign exception in one line, or its kind where it has none."""
    return " ".join(str(error).split()) or type(error).__name__
