"""Reads pickles as data: what a file asks for is noted down, and made by fixed tables.

Python's own reader steps through a pickle. Its instructions that ask for a class or a call note
down what was asked for, and nothing is imported or called. From these notes, `Build` makes what the
tables of `safe_files.known_objects` know, and refuses the rest.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, ClassVar

from safe_files.archives import MAX_INTEGER_BITS
from safe_files.files import Budget, UnsafeFileError, shown

# What protocols 4 and 5 write, which the library has used throughout its second version, by the
# most bytes that an instruction makes beside those that stand in the file. Left out are persistent
# ids, extension codes, buffers out of band, and keyword arguments.
_BY_PRICE = {
    32: "PROTO FRAME STOP NONE NEWTRUE NEWFALSE EMPTY_TUPLE POP POP_MARK APPEND APPENDS ADDITEMS "
    "SETITEM SETITEMS BINGET LONG_BINGET BUILD",
    72: "BININT BININT1 BININT2 LONG1 LONG4 BINFLOAT EMPTY_LIST EMPTY_DICT TUPLE1 TUPLE2 TUPLE3 "
    "TUPLE",
    104: "MARK MEMOIZE SHORT_BINUNICODE BINUNICODE BINUNICODE8 SHORT_BINBYTES BINBYTES BINBYTES8 "
    "BYTEARRAY8 STACK_GLOBAL",
    320: "EMPTY_SET FROZENSET REDUCE NEWOBJ",
}
PRICES = {name: price for price, names in _BY_PRICE.items() for name in names.split()}
# Which values on the stack an instruction makes keys of dictionaries or members of sets.
_KEYS: Mapping[str, slice] = {
    "SETITEM": slice(-2, -1),
    "SETITEMS": slice(None, None, 2),
    "ADDITEMS": slice(None),
    "FROZENSET": slice(None),
}
# What keys may be: the hash of a nested tuple can take for ever. Whole numbers are their own hash
# up to here; of larger ones any number can have the same.
_KINDS_OF_KEYS = (str, int, float, bytes, type(None))
_END_OF_INTEGERS = (1 << 61) - 1
_BYTES_PER_KEY = 160

MAX_DEPTH = 40
# What a value takes, with its place in what holds it; a list, dictionary or object besides; and
# what is noted down about one that is not empty.
_BYTES_PER_VALUE, _BYTES_PER_HOLDER, _BYTES_PER_NOTE = 32, 80, 256
# Constructors of spaces make several arrays of each that they are given.
_SPACES, _COPIES_OF_A_SPACE = "gymnasium.spaces.", 4
_REFUSED = "which may not stand in such a file"

_PLAIN = (type(None), bool, int, float, str, bytes)


@dataclass(frozen=True, slots=True)
class Name:
    """A class or function that the file refers to, by its module's name and its own in there."""

    module: str
    qualname: str

    @property
    def name(self) -> str:
        """The full name."""
        return f"{self.module}.{self.qualname}"


@dataclass(eq=False, repr=False, slots=True)
class Made:
    """An object that the file asks for; Python's instructions fill it as they would the object."""

    maker: Name | Made  # the class or function to call, or what is to make it first
    args: tuple[Any, ...]  # what to call it with
    state: Any = None  # what to give it as its state
    items: list[Any] = field(default_factory=list)  # what to append to it
    pairs: list[tuple[Any, Any]] = field(default_factory=list)  # keys and values to set in it

    def append(self, item: Any) -> None:
        self.items.append(item)

    def __setitem__(self, key: Any, value: Any) -> None:
        self.pairs.append((key, value))

    @property
    def name(self) -> str:
        """What makes it, in words. Of its arguments nothing: written out, they may have no end."""
        return self.maker.name if isinstance(self.maker, Name) else "a call of what a call returns"


class Reader(pickle._Unpickler):
    """Python's own reader of pickles, which calls nothing and imports nothing."""

    prices: ClassVar[Mapping[str, int]] = PRICES
    dispatch: ClassVar[dict[int, Any]]
    stack: list[Any]
    metastack: list[list[Any]]
    read: Callable[[int], bytes]

    def __init__(self, file: io.BytesIO, budget: Budget) -> None:
        super().__init__(file)
        self.budget = budget
        self.names: set[Name] = set()  # all that the file refers to

    def load(self) -> Any:
        """The next pickle of the file, as lists, names, objects to make, and plain data."""
        try:
            tree = super().load()
        except UnsafeFileError:
            raise
        except Exception as error:  # a damaged one can fail at any instruction
            reason = str(error) or type(error).__name__
            raise UnsafeFileError(f"is no whole pickle: {reason}") from error
        if self.stack or self.metastack:
            raise UnsafeFileError("is no whole pickle: something is left over")
        return tree

    def follow(self, name: str, run: Callable[[Reader], None]) -> None:
        """Run an instruction, if it is known and paid for, and look at what it leaves."""
        if name not in self.prices:
            raise UnsafeFileError(f"a pickle with the instruction {name}")
        self.budget.charge(self.prices[name])
        for key in self.stack[_KEYS[name]] if name in _KEYS else ():
            self.budget.charge(_BYTES_PER_KEY)
            if type(key) not in _KINDS_OF_KEYS:
                raise UnsafeFileError(f"uses a {type(key).__name__} as the key of a dictionary")
            if isinstance(key, int) and abs(key) >= _END_OF_INTEGERS:
                raise UnsafeFileError("uses an absurdly large number as the key of a dictionary")
        run(self)
        top = self.stack[-1] if self.stack else None
        if isinstance(top, int) and top.bit_length() > MAX_INTEGER_BITS:
            raise UnsafeFileError("an absurdly large number")
        if isinstance(top, str) and not top.isascii():
            # One character can make all others four bytes wide.
            self.budget.charge(4 * len(top))

    def find_class(self, module: str, name: str) -> Name:
        """Note down a name, where Python would import something."""
        found = Name(module, name)
        self.names.add(found)
        return found

    def load_reduce(self) -> None:
        args, maker = self.stack.pop(), self.stack.pop()
        if not (isinstance(maker, Name | Made) and isinstance(args, tuple)):
            raise UnsafeFileError("a pickle that calls what is no name")
        self.stack.append(Made(maker, args))

    load_newobj = load_reduce

    def load_build(self) -> None:
        state, top = self.stack.pop(), self.stack[-1]
        if not isinstance(top, Made) or top.state is not None:
            raise UnsafeFileError("a pickle that sets the state of what is no new object")
        top.state = state

    def load_bytearray8(self) -> None:
        # Python would make room for all that it says, before it sees what there is.
        (size,) = struct.unpack("<Q", self.read(8))
        self.stack.append(self.read(size))


def _instruction(op: pickletools.OpcodeInfo) -> Callable[[Reader], None]:
    pythons: Any = pickle._Unpickler.dispatch
    # Those that the reader has of its own go by the names of Python's.
    run = getattr(Reader, pythons[ord(op.code)].__name__)
    return lambda reader: reader.follow(op.name, run)


Reader.dispatch = {ord(op.code): _instruction(op) for op in pickletools.opcodes}


def read_tree(pickled: bytes, budget: Budget | None = None) -> Any:
    """What a pickle of protocol 4 or 5 says; a part that the file shares is shared."""
    budget = budget or Budget(len(pickled))
    budget.charge(len(pickled))
    return Reader(io.BytesIO(pickled), budget).load()


def _parts_of(tree: Any) -> Iterable[Any]:
    if isinstance(tree, Made):
        return tree.maker, tree.args, tree.state, tree.items, tree.pairs
    if isinstance(tree, dict):
        return chain(tree, tree.values())
    return tree if isinstance(tree, list | tuple | set | frozenset) else ()


# --- making what was noted down -------------------------------------------------------------------

Maker = Callable[[Made, "Build"], Any]


class Build:
    """Makes the parts of a tree by tables of makers, each found by the full name in the file.

    What is shared is made once.
    """

    def __init__(
        self, makers: Mapping[str, Maker], classes: Mapping[str, type], budget: Budget
    ) -> None:
        self.makers = makers
        self.classes = classes
        self.budget = budget
        self._measures: dict[int, tuple[int, int] | None] = {}
        self._made: dict[int, Any] = {}

    def whole(self, tree: Any) -> Any:
        """Make all of a tree, once it is paid for; what is shared, at each of its places."""
        try:
            self.budget.charge(self._measure(tree)[0])
        except RecursionError:
            raise UnsafeFileError(f"is nested more than {MAX_DEPTH} deep") from None
        return self(tree)

    def _measure(self, tree: Any) -> tuple[int, int]:
        """Bytes of a part, and how deep it is."""
        if isinstance(tree, _PLAIN):
            return _BYTES_PER_VALUE + (len(tree) if isinstance(tree, str | bytes) else 0), 0
        if not isinstance(tree, Name | Made) and not tree:
            return _BYTES_PER_HOLDER, 0
        key = id(tree)
        if key not in self._measures:
            self.budget.charge(_BYTES_PER_NOTE)
            self._measures[key] = None  # it is under way
            size, depth = _BYTES_PER_HOLDER, 0
            for part in _parts_of(tree):
                size_of_part, depth_of_part = self._measure(part)
                size, depth = size + size_of_part, max(depth, depth_of_part)
            if depth == MAX_DEPTH:
                raise UnsafeFileError(f"is nested more than {MAX_DEPTH} deep")
            is_space = isinstance(tree, Made) and tree.name.startswith(_SPACES)
            self._measures[key] = size * (_COPIES_OF_A_SPACE if is_space else 1), depth + 1
        measure = self._measures[key]
        if measure is None:
            raise UnsafeFileError("refers to itself")
        return measure

    def __call__(self, tree: Any) -> Any:
        """Make one part of the tree."""
        if isinstance(tree, _PLAIN):
            return tree
        if not isinstance(tree, Name | Made) and not tree:
            return type(tree)()
        if id(tree) not in self._made:
            self._made[id(tree)] = self._make(tree)
        return self._made[id(tree)]

    def _make(self, tree: Any) -> Any:
        if isinstance(tree, dict):
            return {key: self(value) for key, value in tree.items()}
        if not isinstance(tree, Name | Made):
            return type(tree)(map(self, tree))  # a list, tuple or set
        # As the present versions of the libraries have it: NumPy 2 renamed its inner package.
        name = tree.name.replace("numpy.core.", "numpy._core.", 1)
        if isinstance(tree, Name):
            if name not in self.classes:
                raise UnsafeFileError(f"refers to {_quoted(tree.name)}, {_REFUSED}")
            return self.classes[name]
        if name not in self.makers:
            raise UnsafeFileError(f"holds {_quoted(tree.name)}, {_REFUSED}")
        try:
            return self.makers[name](tree, self)
        except UnsafeFileError:
            raise
        except Exception as error:  # the libraries' constructors can fail in any way
            raise wrong(tree) from error


def _quoted(name: str) -> str:
    return shown(name).strip("'")


# --- what makers are written with -----------------------------------------------------------------


def arguments(made: Made, build: Build, *kinds: type | tuple[type, ...]) -> tuple[Any, ...]:
    """The arguments of a call, which must be of these kinds, and nothing besides them."""
    values = build(made.args)
    fits = len(values) == len(kinds) and all(map(isinstance, values, kinds))
    if not fits or made.state is not None or made.items or made.pairs:
        raise wrong(made)
    return tuple(values)


def fields(made: Made, build: Build) -> dict[str, Any]:
    """The attributes that an object is given."""
    state = {} if made.state is None else build(made.state)
    fits = isinstance(state, dict) and all(isinstance(key, str) for key in state)
    if not fits or made.args or made.items or made.pairs:
        raise wrong(made)
    return dict(state)


def wrong(made: Made) -> UnsafeFileError:
    """The refusal of an object that is not given what genuine files give it."""
    return UnsafeFileError(f"holds a {_quoted(made.name)} that is not as the library writes it")
