"""Pickles read as data: a tree of what the file says, for which nothing was imported or called.

A pickle is a program for a small machine with a stack. `read_tree` steps through it, and where the
program asks for a class or a call, it notes down that it asked. What may come of that is decided
elsewhere, see `safe_files.rebuilding`; Python's own unpickler is never started.
"""

from __future__ import annotations

import io
import pickletools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from safe_files.limits import MAX_INSTRUCTIONS, MAX_INTEGER_BITS
from safe_files.refusals import UnsafeFileError


@dataclass(frozen=True, slots=True)
class Name:
    """A class or function that the file refers to.

    Attributes:
        module: its module's dotted name.
        qualname: its name in there.
    """

    module: str
    qualname: str

    def __str__(self) -> str:
        return f"{self.module}.{self.qualname}"


@dataclass(eq=False, slots=True)
class Mapped:
    """A dictionary as the file says it: keys are hashed once they are known to be harmless."""

    pairs: list[tuple[Any, Any]] = field(default_factory=list)


@dataclass(eq=False, slots=True)
class Grouped:
    """A set as the file says it; see `Mapped`."""

    items: list[Any] = field(default_factory=list)


@dataclass(eq=False, slots=True)
class Made:
    """An object that the file asks for.

    Attributes:
        maker: the class or function to call, or what is to make it first.
        args: what to call it with.
        state: what to give it as its state, or None.
        items: what to append to it.
        pairs: keys and values to set in it.
    """

    maker: Name | Made
    args: tuple[Any, ...]
    state: Any = None
    items: list[Any] = field(default_factory=list)
    pairs: list[tuple[Any, Any]] = field(default_factory=list)


Plain = None | bool | int | float | str | bytes
Tree = Plain | list[Any] | tuple[Any, ...] | Name | Mapped | Grouped | Made


def read_tree(pickled: bytes) -> Tree:
    """Read one pickle.

    Args:
        pickled: a pickle of protocol 4 or 5.

    Returns:
        What it says: numbers, texts and bytes as they are, lists and tuples of trees, and the
        classes of this module for the rest. A part that the file shares is shared.

    Raises:
        UnsafeFileError: if it is no whole pickle, too large, or uses instructions that files of
            this kind have no use for.
    """
    machine = _Machine()
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(io.BytesIO(pickled))):
            if count > MAX_INSTRUCTIONS:
                raise UnsafeFileError(f"a pickle of more than {MAX_INSTRUCTIONS:,} instructions")
            instruction = _INSTRUCTIONS.get(opcode.name)
            if instruction is None:
                raise UnsafeFileError(f"a pickle with the instruction {opcode.name}")
            instruction(machine, argument)
    except UnsafeFileError:
        raise
    except (ValueError, IndexError, KeyError, TypeError, OverflowError) as error:
        raise UnsafeFileError(f"is no whole pickle: {error}") from error
    return machine.result


class _Machine:
    """The stack, those that marks have put aside, and the memo."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.aside: list[list[Any]] = []
        self.memo: dict[int, Any] = {}
        self.result: Tree = None

    def push(self, value: Any) -> None:
        self.stack.append(value)

    def push_number(self, value: int) -> None:
        if value.bit_length() > MAX_INTEGER_BITS:
            raise UnsafeFileError("an absurdly large number")
        self.stack.append(value)

    def throw_away(self) -> None:
        """Take what is on top; a call in vain may have been meant to change what it is given."""
        (top,) = self.take(1)
        if isinstance(top, Made) and str(top.maker).endswith("._function_setstate"):
            made, state = top.args
            self.push(made)
            self.push(state)
            self.build()
            self.stack.pop()

    def mark(self) -> None:
        self.aside.append(self.stack)
        self.stack = []

    def since_mark(self) -> list[Any]:
        """Take everything above the last mark."""
        taken, self.stack = self.stack, self.aside.pop()
        return taken

    def take(self, n: int) -> list[Any]:
        """Take the topmost ``n`` values."""
        if len(self.stack) < n:
            raise IndexError("too little on the stack")
        taken, self.stack[-n:] = self.stack[-n:], []
        return taken

    def extend(self, values: list[Any]) -> None:
        """Append to the list, set or object on top."""
        top = self.stack[-1]
        if isinstance(top, Grouped | Made):
            top.items.extend(values)
        elif isinstance(top, list):
            top.extend(values)
        else:
            raise TypeError(f"nothing can be appended to a {type(top).__name__}")

    def set_items(self, values: list[Any]) -> None:
        """Set keys, each followed by its value, in the dictionary or object on top."""
        top = self.stack[-1]
        if not isinstance(top, Mapped | Made):
            raise TypeError(f"no keys can be set in a {type(top).__name__}")
        top.pairs.extend(zip(values[::2], values[1::2], strict=True))

    def refer(self) -> None:
        module, qualname = self.take(2)
        if not (isinstance(module, str) and isinstance(qualname, str)):
            raise UnsafeFileError("a pickle that refers to what is no name")
        self.push(Name(module, qualname))

    def call(self) -> None:
        maker, args = self.take(2)
        if not (isinstance(maker, Name | Made) and isinstance(args, tuple)):
            raise UnsafeFileError("a pickle that calls what is no name")
        self.push(Made(maker, args))

    def build(self) -> None:
        state = self.stack.pop()
        top = self.stack[-1]
        if not isinstance(top, Made) or top.state is not None:
            raise UnsafeFileError("a pickle that sets the state of what is no new object")
        top.state = state

    def stop(self) -> None:
        (self.result,) = self.stack
        if self.aside:
            raise ValueError("a mark is left over")


_Instruction = Callable[[_Machine, Any], object]


def _each(names: str, instruction: _Instruction) -> dict[str, _Instruction]:
    return dict.fromkeys(names.split(), instruction)


# What protocols 4 and 5 write, which the library has used throughout its second version. Left out
# are persistent ids, extension codes, buffers out of band, and keyword arguments.
_INSTRUCTIONS: Mapping[str, _Instruction] = {
    **_each("PROTO FRAME", lambda m, arg: None),
    **_each("BININT BININT1 BININT2 LONG1 LONG4", _Machine.push_number),
    **_each("BINFLOAT SHORT_BINUNICODE BINUNICODE BINUNICODE8", _Machine.push),
    **_each("SHORT_BINBYTES BINBYTES BINBYTES8 BYTEARRAY8", lambda m, arg: m.push(bytes(arg))),
    "NONE": lambda m, arg: m.push(None),
    "NEWTRUE": lambda m, arg: m.push(True),
    "NEWFALSE": lambda m, arg: m.push(False),
    "EMPTY_LIST": lambda m, arg: m.push([]),
    "EMPTY_TUPLE": lambda m, arg: m.push(()),
    "EMPTY_DICT": lambda m, arg: m.push(Mapped()),
    "EMPTY_SET": lambda m, arg: m.push(Grouped()),
    "TUPLE1": lambda m, arg: m.push(tuple(m.take(1))),
    "TUPLE2": lambda m, arg: m.push(tuple(m.take(2))),
    "TUPLE3": lambda m, arg: m.push(tuple(m.take(3))),
    "TUPLE": lambda m, arg: m.push(tuple(m.since_mark())),
    "FROZENSET": lambda m, arg: m.push(Grouped(m.since_mark())),
    "MARK": lambda m, arg: m.mark(),
    "POP": lambda m, arg: m.throw_away(),
    "POP_MARK": lambda m, arg: m.since_mark(),
    "APPEND": lambda m, arg: m.extend(m.take(1)),
    **_each("APPENDS ADDITEMS", lambda m, arg: m.extend(m.since_mark())),
    "SETITEM": lambda m, arg: m.set_items(m.take(2)),
    "SETITEMS": lambda m, arg: m.set_items(m.since_mark()),
    "MEMOIZE": lambda m, arg: m.memo.__setitem__(len(m.memo), m.stack[-1]),
    **_each("BINGET LONG_BINGET", lambda m, arg: m.push(m.memo[arg])),
    "STACK_GLOBAL": lambda m, arg: m.refer(),
    **_each("REDUCE NEWOBJ", lambda m, arg: m.call()),
    "BUILD": lambda m, arg: m.build(),
    "STOP": lambda m, arg: m.stop(),
}
