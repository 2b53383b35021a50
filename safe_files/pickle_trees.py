"""Pickles read as data: a tree of what the file says, for which nothing was imported or called.

A pickle is a program for a small machine with a stack. Python's own one, written in Python, steps
through it here, in which the instructions that ask for a class or a call were replaced: they note
down what was asked for. What may come of that is decided elsewhere, see `safe_files.rebuilding`.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import struct
from collections.abc import Callable, Iterable, Mapping
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
    """Read one pickle.

    Args:
        pickled: a pickle of protocol 4 or 5.
        budget: pays for the tree; None for that of such a file.

    Returns:
        What it says: plain data, lists, tuples, dictionaries and sets as they are, and the classes
        of this module for the rest. A part that the file shares is shared.

    Raises:
        UnsafeFileError: if it is no whole pickle, takes too much, or uses instructions that files
            of this kind have no use for.
    """
    budget = budget or Budget(len(pickled))
    budget.charge(len(pickled))
    tree: Tree = TreeReader(io.BytesIO(pickled), budget).load()
    return tree


# For each key that is set, a row of a table that grows by doubling.
_BYTES_PER_KEY = 160


class TreeReader(pickle._Unpickler):
    """Python's own reader of pickles, which calls nothing and imports nothing."""

    dispatch: ClassVar[dict[int, Any]]
    stack: list[Any]
    metastack: list[list[Any]]
    read: Callable[[int], bytes]
    pop_mark: Callable[[], list[Any]]

    def __init__(self, file: io.BytesIO, budget: Budget) -> None:
        super().__init__(file)
        self.budget = budget

    def load(self) -> Any:
        """The next pickle of the file as a tree.

        Raises:
            UnsafeFileError: see `read_tree`.
        """
        try:
            tree = super().load()
        except UnsafeFileError:
            raise
        except Exception as error:  # a damaged one can fail at any instruction
            raise UnsafeFileError(f"is no whole pickle: {error}") from error
        if self.stack or self.metastack:
            raise UnsafeFileError("is no whole pickle: something is left over")
        return tree

    def find_class(self, module: str, name: str) -> Name:
        """Note down a name; the machine calls this where it would import something."""
        return Name(module, name)

    def call(self) -> None:
        args, maker = self.stack.pop(), self.stack.pop()
        if not (isinstance(maker, Name | Made) and isinstance(args, tuple)):
            raise UnsafeFileError("a pickle that calls what is no name")
        self.stack.append(Made(maker, args))

    def build(self) -> None:
        state, top = self.stack.pop(), self.stack[-1]
        if not isinstance(top, Made) or top.state is not None:
            raise UnsafeFileError("a pickle that sets the state of what is no new object")
        top.state = state

    def throw_away(self) -> None:
        """Take what is on top; a call in vain may have been meant to change what it is given."""
        top = self.stack.pop()
        if isinstance(top, Made) and str(top.maker).endswith("._function_setstate"):
            self.stack.extend(top.args)
            self.build()
            self.stack.pop()

    def long_number(self, read: Callable[[TreeReader], None]) -> None:
        read(self)
        if self.stack[-1].bit_length() > MAX_INTEGER_BITS:
            raise UnsafeFileError("an absurdly large number")

    def text(self, read: Callable[[TreeReader], None]) -> None:
        read(self)
        # Of characters that are not of ASCII, one can make all others four bytes wide.
        self.budget.charge(0 if self.stack[-1].isascii() else 4 * len(self.stack[-1]))

    def byte_array(self) -> None:
        (size,) = struct.unpack("<Q", self.read(8))
        # Python's own would make room for all that it says, before it finds how much there is.
        self.stack.append(self.read(size))

    def append_one(self) -> None:
        self._extend([self.stack.pop()])

    def append_many(self) -> None:
        self._extend(self.pop_mark())

    def _extend(self, values: list[Any]) -> None:
        """Append to the list, set or object on top."""
        top = self.stack[-1]
        if isinstance(top, set):
            top.update(map(self._key, values))
            return
        if not isinstance(top, list | Made):
            raise TypeError(f"nothing can be appended to a {type(top).__name__}")
        (top.items if isinstance(top, Made) else top).extend(values)

    def set_one(self) -> None:
        values = self.stack[-2:]
        del self.stack[-2:]
        self._set(values)

    def set_many(self) -> None:
        self._set(self.pop_mark())

    def _set(self, values: list[Any]) -> None:
        """Set keys, each followed by its value, in the dictionary or object on top."""
        top = self.stack[-1]
        pairs = list(zip(values[::2], values[1::2], strict=True))
        if isinstance(top, Made):
            self.budget.charge(_BYTES_PER_KEY * len(pairs))
            top.pairs.extend(pairs)
        elif isinstance(top, dict):
            top.update((self._key(key), value) for key, value in pairs)
        else:
            raise TypeError(f"no keys can be set in a {type(top).__name__}")

    def frozen(self) -> None:
        items = self.pop_mark()
        self.stack.append(set(map(self._key, items)))

    def _key(self, key: Any) -> Any:
        self.budget.charge(_BYTES_PER_KEY)
        if type(key) not in KEYS:
            raise UnsafeFileError(f"uses a {type(key).__name__} as the key of a dictionary")
        if isinstance(key, int) and abs(key) >= _END_OF_INTEGERS:
            raise UnsafeFileError("uses an absurdly large number as the key of a dictionary")
        return key


_Run = Callable[[TreeReader], None]
_RUN: dict[str, Any] = {
    op.name: pickle._Unpickler.dispatch[ord(op.code)] for op in pickletools.opcodes
}


def _longer(run: Callable[..., None], *names: str) -> dict[str, _Run]:
    return {name: partial(run, read=_RUN[name]) for name in names}


_OWN: Mapping[str, _Run] = {
    **_longer(TreeReader.long_number, "LONG1", "LONG4"),
    **_longer(TreeReader.text, "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
    "BYTEARRAY8": TreeReader.byte_array,
    "POP": TreeReader.throw_away,
    "APPEND": TreeReader.append_one,
    "APPENDS": TreeReader.append_many,
    "ADDITEMS": TreeReader.append_many,
    "SETITEM": TreeReader.set_one,
    "SETITEMS": TreeReader.set_many,
    "FROZENSET": TreeReader.frozen,
    "REDUCE": TreeReader.call,
    "NEWOBJ": TreeReader.call,
    "BUILD": TreeReader.build,
}
# What protocols 4 and 5 write, which the library has used throughout its second version, and the
# most bytes that each makes beside those that stand in the file. Left out are persistent ids,
# extension codes, buffers out of band, and keyword arguments.
COSTS = {
    64: "PROTO FRAME BININT BININT1 BININT2 LONG1 LONG4 BINFLOAT NONE NEWTRUE NEWFALSE BINGET "
    "LONG_BINGET EMPTY_TUPLE TUPLE1 TUPLE2 TUPLE3 TUPLE POP POP_MARK APPEND APPENDS ADDITEMS "
    "SETITEM SETITEMS BUILD STOP",
    128: "SHORT_BINUNICODE BINUNICODE BINUNICODE8 SHORT_BINBYTES BINBYTES BINBYTES8 BYTEARRAY8 "
    "EMPTY_LIST EMPTY_DICT MARK MEMOIZE STACK_GLOBAL",
    320: "EMPTY_SET FROZENSET REDUCE NEWOBJ",
}


def instructions(costs: Mapping[int, str]) -> dict[int, _Run]:
    """What a reader does at each code: what those cost that it knows, and no others."""
    cost = {name: n_bytes for n_bytes, names in costs.items() for name in names.split()}

    def step(reader: TreeReader, name: str) -> None:
        if name not in cost:
            raise UnsafeFileError(f"a pickle with the instruction {name}")
        reader.budget.charge(cost[name])
        (_OWN.get(name) or _RUN[name])(reader)

    return {ord(op.code): partial(step, name=op.name) for op in pickletools.opcodes}


TreeReader.dispatch = instructions(COSTS)
