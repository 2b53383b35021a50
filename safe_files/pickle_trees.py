"""Pickles read as data: a tree of what the file says, for which nothing was imported or called.

A pickle is a program for a small machine with a stack. Python's own one, written in Python, steps
through it here, in which the instructions that ask for a class or a call were replaced: they note
down what was asked for. What may come of that is decided elsewhere, see `safe_files.rebuilding`.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import re
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import Any, ClassVar

from safe_files.limits import MAX_INTEGER_BITS, Budget
from safe_files.refusals import UnsafeFileError

# What dictionaries may be keyed by: the hash of a nested tuple can take for ever. Whole numbers
# are their own hash up to here; of larger ones any number can have the same.
KEYS = (str, int, float, bytes, type(None))
_END_OF_INTEGERS = (1 << 61) - 1

# What protocols 4 and 5 write, which the library has used throughout its second version. Left out
# are persistent ids, extension codes, buffers out of band, and keyword arguments.
_INSTRUCTIONS = (
    "PROTO FRAME STOP NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 LONG1 LONG4 BINFLOAT "
    "SHORT_BINUNICODE BINUNICODE BINUNICODE8 SHORT_BINBYTES BINBYTES BINBYTES8 BYTEARRAY8 "
    "EMPTY_LIST EMPTY_TUPLE EMPTY_DICT EMPTY_SET TUPLE1 TUPLE2 TUPLE3 TUPLE FROZENSET MARK POP "
    "POP_MARK APPEND APPENDS ADDITEMS SETITEM SETITEMS MEMOIZE BINGET LONG_BINGET STACK_GLOBAL "
    "REDUCE NEWOBJ BUILD"
)
INSTRUCTIONS = frozenset(_INSTRUCTIONS.split())
# The most bytes that an instruction makes beside those that stand in the file, and a key.
_BYTES, _BYTES_OF_A_PLACE, _BYTES_OF_AN_OBJECT, _BYTES_PER_KEY = 72, 104, 320, 160
_MAKES_A_PLACE = re.compile("MARK|MEMOIZE|PUT|UNICODE|BYTE")
_MAKES_AN_OBJECT = re.compile("SET$|REDUCE|NEWOBJ|PERSID")


@dataclass(frozen=True, slots=True)
class Name:
    """A class or function that the file refers to, by its module's name and its own in there."""

    module: str
    qualname: str

    def __str__(self) -> str:
        return f"{self.module}.{self.qualname}"


@dataclass(eq=False, slots=True)
class Made:
    """An object that the file asks for."""

    maker: Name | Made  # the class or function to call, or what is to make it first
    args: tuple[Any, ...]  # what to call it with
    state: Any = None  # what to give it as its state
    items: list[Any] = field(default_factory=list)  # what to append to it
    pairs: list[tuple[Any, Any]] = field(default_factory=list)  # keys and values to set in it


Plain = None | bool | int | float | str | bytes
PLAIN = (type(None), bool, int, float, str, bytes)
Tree = Plain | list[Any] | tuple[Any, ...] | dict[Any, Any] | set[Any] | Name | Made


def parts_of(tree: Tree) -> Iterable[Any]:
    """What a list, tuple, dictionary, set or object consists of."""
    match tree:
        case Made():
            return tree.maker, tree.args, tree.state, tree.items, tree.pairs
        case dict():
            return chain(tree, tree.values())
        case list() | tuple() | set():
            return tree
    return ()


def read_tree(pickled: bytes, budget: Budget | None = None) -> Tree:
    """What a pickle of protocol 4 or 5 says; a part that the file shares is shared.

    Without a budget, that of such a file pays for it.
    """
    budget = budget or Budget(len(pickled))
    budget.charge(len(pickled))
    tree: Tree = TreeReader(io.BytesIO(pickled), budget).load()
    return tree


class TreeReader(pickle._Unpickler):
    """Python's own reader of pickles, which calls nothing and imports nothing.

    What ``run_`` an instruction does takes the place of Python's own.
    """

    dispatch: ClassVar[dict[int, Any]]
    stack: list[Any]
    metastack: list[list[Any]]
    read: Callable[[int], bytes]
    pop_mark: Callable[[], list[Any]]

    def __init__(self, file: io.BytesIO, budget: Budget) -> None:
        super().__init__(file)
        self.budget = budget

    def load(self) -> Any:
        """The next pickle of the file as a tree."""
        try:
            tree = super().load()
        except UnsafeFileError:
            raise
        except Exception as error:  # a damaged one can fail at any instruction
            raise UnsafeFileError(
                f"is no whole pickle: {str(error) or type(error).__name__}"
            ) from error
        if self.stack or self.metastack:
            raise UnsafeFileError("is no whole pickle: something is left over")
        return tree

    def find_class(self, module: str, name: str) -> Name:
        """Note down a name; the machine calls this where it would import something."""
        return Name(module, name)

    def run_reduce(self) -> None:
        args, maker = self.stack.pop(), self.stack.pop()
        if not (isinstance(maker, Name | Made) and isinstance(args, tuple)):
            raise UnsafeFileError("a pickle that calls what is no name")
        self.stack.append(Made(maker, args))

    run_newobj = run_reduce

    def run_build(self) -> None:
        state, top = self.stack.pop(), self.stack[-1]
        if not isinstance(top, Made) or top.state is not None:
            raise UnsafeFileError("a pickle that sets the state of what is no new object")
        top.state = state

    def run_pop(self) -> None:
        # A call in vain may have been meant to change what it is given.
        top = self.stack.pop()
        if isinstance(top, Made) and str(top.maker).endswith("._function_setstate"):
            self.stack.extend(top.args)
            self.run_build()
            self.stack.pop()

    def run_bytearray8(self) -> None:
        (size,) = struct.unpack("<Q", self.read(8))
        # Python's own would make room for all that it says, before it finds how much there is.
        self.stack.append(self.read(size))

    def run_append(self) -> None:
        self._extend([self.stack.pop()])

    def run_appends(self) -> None:
        self._extend(self.pop_mark())

    run_additems = run_appends

    def run_frozenset(self) -> None:
        items = self.pop_mark()
        self.stack.append(set())
        self._extend(items)

    def _extend(self, values: list[Any]) -> None:
        """Append to the list, set or object on top."""
        match self.stack[-1]:
            case Made() as made:
                made.items.extend(values)
            case list() as items:
                items.extend(values)
            case set() as items:
                items.update(map(self._key, values))
            case top:
                raise TypeError(f"nothing can be appended to a {type(top).__name__}")

    def run_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set([(key, value)])

    def run_setitems(self) -> None:
        values = self.pop_mark()
        self._set(zip(values[::2], values[1::2], strict=True))

    def _set(self, pairs: Iterable[tuple[Any, Any]]) -> None:
        """Set keys and values in the dictionary or object on top."""
        match self.stack[-1]:
            case Made() as made:
                made.pairs.extend(pairs)
            case dict() as items:
                items.update((self._key(key), value) for key, value in pairs)
            case top:
                raise TypeError(f"no keys can be set in a {type(top).__name__}")

    def _key(self, key: Any) -> Any:
        self.budget.charge(_BYTES_PER_KEY)
        if type(key) not in KEYS:
            raise UnsafeFileError(f"uses a {type(key).__name__} as the key of a dictionary")
        if isinstance(key, int) and abs(key) >= _END_OF_INTEGERS:
            raise UnsafeFileError("uses an absurdly large number as the key of a dictionary")
        return key

    def check_top(self) -> None:
        """Hold what was read last against its limits."""
        top = self.stack[-1] if self.stack else None
        if isinstance(top, int) and top.bit_length() > MAX_INTEGER_BITS:
            raise UnsafeFileError("an absurdly large number")
        if isinstance(top, str) and not top.isascii():
            # One character can make all others four bytes wide.
            self.budget.charge(4 * len(top))


def instructions(known: Iterable[str]) -> dict[int, Callable[[TreeReader], None]]:
    """What a reader does at each code: it pays, or refuses what is not known."""
    return {
        ord(op.code): partial(_step, op, _cost(op.name) if op.name in known else None)
        for op in pickletools.opcodes
    }


def _cost(name: str) -> int:
    if _MAKES_AN_OBJECT.search(name):
        return _BYTES_OF_AN_OBJECT
    return _BYTES_OF_A_PLACE if _MAKES_A_PLACE.search(name) else _BYTES


def _step(op: pickletools.OpcodeInfo, n_bytes: int | None, reader: TreeReader) -> None:
    if n_bytes is None:
        raise UnsafeFileError(f"a pickle with the instruction {op.name}")
    reader.budget.charge(n_bytes)
    own = getattr(reader, f"run_{op.name.lower()}", None)
    pythons: Any = pickle._Unpickler.dispatch
    own() if own is not None else pythons[ord(op.code)](reader)
    reader.check_top()


TreeReader.dispatch = instructions(INSTRUCTIONS)
