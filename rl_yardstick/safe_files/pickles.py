"""Reads pickles as data: records the requested calls, and builds objects by fixed tables.

Python's own reader steps through a pickle. Instructions that ask for a class or a call only record
the request: nothing is imported or called. From these records, `Build` makes the objects that the
tables of `safe_files.known_objects` know, and refuses all others.
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

from rl_yardstick.safe_files.archives import MAX_INTEGER_BITS
from rl_yardstick.safe_files.files import Budget, UnsafeFileError, shown

# The instructions of protocols 4 and 5, which version 2 of the library writes, with the most bytes
# that an instruction allocates beyond its bytes in the file. Not supported are persistent ids,
# extension codes, out-of-band buffers, and keyword arguments.
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
# The values on the stack that an instruction uses as dictionary keys or members of sets.
_KEYS: Mapping[str, slice] = {
    "SETITEM": slice(-2, -1),
    "SETITEMS": slice(None, None, 2),
    "ADDITEMS": slice(None),
    "FROZENSET": slice(None),
}
# Types of keys: hashing a nested tuple can take for ever. Integers up to here are their own hash;
# any number of larger ones can share a hash.
_KINDS_OF_KEYS = (str, int, float, bytes, type(None))
_END_OF_INTEGERS = (1 << 61) - 1
_BYTES_PER_KEY = 160

MAX_DEPTH = 40
# Bytes of a value with its slot in a container; extra bytes of a list, dictionary or object; and
# bytes that `Build` needs to measure one that is not empty.
_BYTES_PER_VALUE, _BYTES_PER_HOLDER, _BYTES_PER_NOTE = 32, 80, 256
# Constructors of spaces make several arrays from each argument.
_SPACES, _COPIES_OF_A_SPACE = "gymnasium.spaces.", 4
_REFUSED = "which may not stand in such a file"

_PLAIN = (type(None), bool, int, float, str, bytes)


@dataclass(frozen=True, slots=True)
class Name:
    """The name of a class or function in the file: its module and its name in the module."""

    module: str
    qualname: str

    @property
    def name(self) -> str:
        """The full dotted name."""
        return f"{self.module}.{self.qualname}"


@dataclass(eq=False, repr=False, slots=True)
class Made:
    """A record of an object that the file requests; pickle instructions fill it like the object."""

    maker: Name | Made  # the class or function to call, or the record of it
    args: tuple[Any, ...]  # arguments of the call
    state: Any = None  # the state to set
    items: list[Any] = field(default_factory=list)  # items to append
    pairs: list[tuple[Any, Any]] = field(default_factory=list)  # keys and values to set

    def append(self, item: Any) -> None:
        self.items.append(item)

    def __setitem__(self, key: Any, value: Any) -> None:
        self.pairs.append((key, value))

    @property
    def name(self) -> str:
        """The name of its class or function, without arguments, which could be endless."""
        return self.maker.name if isinstance(self.maker, Name) else "the result of another call"


class Reader(pickle._Unpickler):
    """Python's own pickle reader, changed so that it calls and imports nothing."""

    prices: ClassVar[Mapping[str, int]] = PRICES
    dispatch: ClassVar[dict[int, Any]]
    stack: list[Any]
    metastack: list[list[Any]]
    read: Callable[[int], bytes]

    def __init__(self, file: io.BytesIO, budget: Budget) -> None:
        super().__init__(file)
        self.budget = budget
        self.names: set[Name] = set()  # all names in the file

    def load(self) -> Any:
        """Read the next pickle of the file as lists, names, object records, and plain data."""
        try:
            tree = super().load()
        except UnsafeFileError:
            raise
        except Exception as error:  # a damaged pickle can fail at any instruction
            reason = str(error) or type(error).__name__
            raise UnsafeFileError(f"is no whole pickle: {reason}") from error
        if self.stack or self.metastack:
            raise UnsafeFileError("is no whole pickle: something is left over")
        return tree

    def follow(self, name: str, run: Callable[[Reader], None]) -> None:
        """Run a known instruction after charging the budget, and check its result."""
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
        """Record a name where Python would import a class."""
        found = Name(module, name)
        self.names.add(found)
        return found

    def load_reduce(self) -> None:
        args, maker = self.stack.pop(), self.stack.pop()
        if not (isinstance(maker, Name | Made) and isinstance(args, tuple)):
            raise UnsafeFileError("a pickle that calls something that is not a name")
        self.stack.append(Made(maker, args))

    load_newobj = load_reduce

    def load_build(self) -> None:
        state, top = self.stack.pop(), self.stack[-1]
        if not isinstance(top, Made) or top.state is not None:
            raise UnsafeFileError("a pickle that sets the state of an object that is not new")
        top.state = state

    def load_bytearray8(self) -> None:
        # Python would allocate the declared size before it checks the bytes.
        (size,) = struct.unpack("<Q", self.read(8))
        self.stack.append(self.read(size))


def _instruction(op: pickletools.OpcodeInfo) -> Callable[[Reader], None]:
    pythons: Any = pickle._Unpickler.dispatch
    # The reader's own instructions have the names of Python's.
    run = getattr(Reader, pythons[ord(op.code)].__name__)
    return lambda reader: reader.follow(op.name, run)


Reader.dispatch = {ord(op.code): _instruction(op) for op in pickletools.opcodes}


def read_tree(pickled: bytes, budget: Budget | None = None) -> Any:
    """Read a pickle of protocol 4 or 5 as a tree; shared parts stay shared."""
    budget = budget or Budget(len(pickled))
    budget.charge(len(pickled))
    return Reader(io.BytesIO(pickled), budget).load()


def _parts_of(tree: Any) -> Iterable[Any]:
    if isinstance(tree, Made):
        return tree.maker, tree.args, tree.state, tree.items, tree.pairs
    if isinstance(tree, dict):
        return chain(tree, tree.values())
    return tree if isinstance(tree, list | tuple | set | frozenset) else ()


# --- building the recorded objects ----------------------------------------------------------------

Maker = Callable[[Made, "Build"], Any]


class Build:
    """Builds the parts of a tree by tables of makers, keyed by the full name in the file.

    A shared part is built once.
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
        """Build a whole tree after charging it; a shared part is charged at each of its places."""
        try:
            self.budget.charge(self._measure(tree)[0])
        except RecursionError:
            raise UnsafeFileError(f"is nested more than {MAX_DEPTH} deep") from None
        return self(tree)

    def _measure(self, tree: Any) -> tuple[int, int]:
        """The bytes and the depth of a part."""
        if isinstance(tree, _PLAIN):
            return _BYTES_PER_VALUE + (len(tree) if isinstance(tree, str | bytes) else 0), 0
        if not isinstance(tree, Name | Made) and not tree:
            return _BYTES_PER_HOLDER, 0
        key = id(tree)
        if key not in self._measures:
            self.budget.charge(_BYTES_PER_NOTE)
            self._measures[key] = None  # in progress
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
        """Build one part of the tree."""
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
        # The name in current versions of the libraries: NumPy 2 renamed its inner package.
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


# --- helpers for makers ---------------------------------------------------------------------------


def arguments(made: Made, build: Build, *kinds: type | tuple[type, ...]) -> tuple[Any, ...]:
    """The arguments of a call, which must have exactly these types; state and items are refused."""
    values = build(made.args)
    fits = len(values) == len(kinds) and all(map(isinstance, values, kinds))
    if not fits or made.state is not None or made.items or made.pairs:
        raise wrong(made)
    return tuple(values)


def fields(made: Made, build: Build) -> dict[str, Any]:
    """The recorded attributes of an object."""
    state = {} if made.state is None else build(made.state)
    fits = isinstance(state, dict) and all(isinstance(key, str) for key in state)
    if not fits or made.args or made.items or made.pairs:
        raise wrong(made)
    return dict(state)


def wrong(made: Made) -> UnsafeFileError:
    """The error for an object whose contents differ from genuine files."""
    return UnsafeFileError(f"holds a {_quoted(made.name)} that is not as the library writes it")
