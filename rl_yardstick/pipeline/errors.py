"""User errors, and helpers for their messages."""

from __future__ import annotations

import difflib
import re
import reprlib
import sysconfig
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

_SHORT_LIST = 12
# Other names of hyperparameters, too different in spelling to be found by similarity.
OTHER_NAMES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("lr", "alpha", "step_size"), ("learning_rate",)),
    **dict.fromkeys(("epsilon", "eps"), ("exploration_final_eps", "exploration_initial_eps")),
    **dict.fromkeys(("discount", "discount_factor"), ("gamma",)),
}

# Where code is that is not the user's own: libraries, this project, Python's imports.
_LIBRARIES = (sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib"))
PACKAGE = f"{Path(__file__).parents[1]}/"
_NOT_OWN = (*_LIBRARIES, PACKAGE, "<frozen")

_brief = reprlib.Repr()
_brief.maxstring = _brief.maxother = 60

# Control characters except line feeds and tabs; characters that change the writing direction; and
# surrogates, which no file can contain.
_OBEYED = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)


class UserError(Exception):
    """A user error: one line that says what is wrong, where, and how to correct it.

    ``example`` has lines to print below it.
    """

    def __init__(self, message: str, example: str = "") -> None:
        self.example = example
        super().__init__(visible(" ".join(line.strip() for line in message.splitlines())))

    def _render_traceback_(self) -> list[str]:
        """What a notebook shows of it: the line, without a traceback."""
        return [f"error: {self}"]


class Stopped(Exception):  # noqa: N818  # no error
    """A signal, whose number it has, has ended the work at a safe moment."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def visible(text: str) -> str:
    """The text with control characters escaped, so that a terminal shows them."""
    return _OBEYED.sub(lambda sign: sign[0].encode("unicode_escape").decode("ascii"), text)


def shown(value: object) -> str:
    """The value as error messages quote it, shortened if it is long."""
    return _brief.repr(value)


def one_line(error: BaseException) -> str:
    """The message of an exception in one line, or its type if it has no message."""
    try:
        return " ".join(str(error).split()) or type(error).__name__
    except Exception:  # noqa: BLE001  # a stranger's `__str__` can fail in any way
        return type(error).__name__


def own_calls(error: BaseException) -> list[traceback.FrameSummary]:
    """The calls in an error's traceback that are in the user's own code."""
    calls = traceback.extract_tb(error.__traceback__)
    return [call for call in calls if not call.filename.startswith(_NOT_OWN)]


@contextmanager
def as_user_error(what: str, *kinds: type[BaseException]) -> Iterator[None]:
    """Errors of these kinds in the block become a `UserError`: ``what``, and their message."""
    try:
        yield
    except kinds as error:
        raise UserError(f"{what}: {one_line(error)}") from error


def did_you_mean(name: str, known: Iterable[str], n: int = 1) -> str:
    """A hint with the nearest known names; or if none is near, with all, unless they are many."""
    by_lower_case = {option.lower(): option for option in known}
    near = [other for other in OTHER_NAMES.get(name.lower(), ()) if other in by_lower_case] or [
        by_lower_case[match] for match in difflib.get_close_matches(name.lower(), by_lower_case, n)
    ]
    if near:
        return f"did you mean {' or '.join(map(repr, near))}?"
    names = by_lower_case.values()
    return f"known are {', '.join(names)}" if 0 < len(names) <= _SHORT_LIST else ""


def unknown(what: str, name: str, known: Iterable[str], n: int = 1) -> UserError:
    """The error for a ``name`` that is not among ``known``: "{what} 'name': did you mean ...?"."""
    hint = did_you_mean(name, known, n)
    if "," in name:
        hint = f"names are separated by blanks: {' '.join(name.replace(',', ' ').split())}"
    return UserError(f"{what} {shown(name)}{': ' if hint else ''}{hint}")
