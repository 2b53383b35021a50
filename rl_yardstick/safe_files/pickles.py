"""Reads pickles as data: records the requested calls, and builds objects by fixed tables.

Python's own reader steps through a pickle, and only records requests for classes and calls. `Build`
makes the objects that the tables of `safe_files.known_objects` know, and refuses all others.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

from rl_yardstick.safe_files.files import Budget, UnsafeFileError, refused_as, shown

# The instructions of protocols 0 to 5, without frozen sets, extension codes, out-of-band buffers,
# Python 2's texts, and keyword arguments.
_NAMES = (
    "INT LONG FLOAT UNICODE LIST DICT PUT GET EMPTY_SET ADDITEMS "
    "PROTO FRAME STOP NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 LONG1 LONG4 BINFLOAT "
    "SHORT_BINUNICODE BINUNICODE BINUNICODE8 SHORT_BINBYTES BINBYTES BINBYTES8 BYTEARRAY8 "
    "EMPTY_LIST EMPTY_TUPLE EMPTY_DICT TUPLE TUPLE1 TUPLE2 TUPLE3 MARK POP POP_MARK APPEND APPENDS "
    "SETITEM SETITEMS MEMOIZE BINPUT LONG_BINPUT BINGET LONG_BINGET GLOBAL STACK_GLOBAL REDUCE "
    "NEWOBJ BUILD BINPERSID"
)
INSTRUCTIONS = frozenset(_NAMES.split())
# Bytes that an instruction, or a part of the built value, takes at most besides its text; and those
# of a sign, since one can make all others of a text four bytes wide.
_PRICE, _BYTES_PER_SIGN = 160, 4
MAX_DEPTH, MAX_INTEGER_BITS = 40, 128
END_OF_KEYS = (1 << 61) - 1  # larger integers are not their own hash: any number can share one
# Packages that were renamed: NumPy's inner one, and Gym, whose spaces Gymnasium took over.
_RENAMED = {"numpy.core.": "numpy._core.", "gym.spaces.": "gymnasium.spaces."}
_RENAMED |= {"copy_reg.": "copyreg.", "__builtin__.": "builtins."}  # in protocols 0 to 2
# The names of records of dictionaries and of persistent ids. Names in a file have a dot.
DICTIONARY, PERSISTENT_ID = "dict", "persistent id"
_NEW_OBJECT = "copyreg._reconstructor"  # how protocols 0 and 1 make an object


@dataclass(frozen=True, slots=True)
class Name:
    """The full name of a class or function in the file."""

    name: str


@dataclass(eq=False, repr=False, slots=True)
class Made:
    """A record of an object that the file requests; pickle instructions fill it like the object."""

    name: str  # the full name of the class or function to call
    args: tuple[Any, ...]  # arguments of the call
    state: Any = None  # the state to set
    items: list[Any] = field(default_factory=list)  # items to append, or keys and values in turn

    def append(self, item: Any) -> None:
        self.items.append(item)

    add = append  # which sets have

    def __setitem__(self, key: Any, value: Any) -> None:
        self.items += (key, value)


class Reader(pickle._Unpickler):
    """Python's own pickle reader, changed so that it calls and imports nothing."""

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)
    append: Callable[[Any], None]
    pop_mark: Callable[[], list[Any]]
    stack: list[Any]

    def __init__(self, file: io.BytesIO, budget: Budget) -> None:
        super().__init__(file)
        self.file, self.budget = file, budget
        self.names: set[str] = set()  # all names in the file
        self.persistent_ids: list[Any] = []

    def load(self) -> Any:
        """Read the next pickle of the file as lists, tuples, names, records, and plain data."""
        start = self.file.tell()
        with refused_as("is no whole pickle"):
            for instruction, argument, _ in pickletools.genops(self.file):
                if instruction.name not in INSTRUCTIONS:
                    raise UnsafeFileError(f"a pickle with the instruction {instruction.name}")
                if isinstance(argument, int) and argument.bit_length() > MAX_INTEGER_BITS:
                    raise UnsafeFileError("holds an absurdly large number")
                factor = _BYTES_PER_SIGN if isinstance(argument, str) else 1
                length = len(argument) if isinstance(argument, str | bytes | bytearray) else 0
                self.budget.charge(_PRICE + factor * length)
            self.file.seek(start)
            return super().load()

    def find_class(self, module: str, name: str) -> Name:
        """Record a name where Python would import a class, as it is in current libraries."""
        self.budget.charge(_BYTES_PER_SIGN * (len(module) + len(name)))
        full = f"{module}.{name}"
        if module.startswith("cloudpickle."):  # as schedules before version 2.6 of the library
            raise UnsafeFileError("holds a function with its code")
        for old, new in _RENAMED.items():
            if full.startswith(old):
                full = new + full.removeprefix(old)
        self.names.add(full)
        return Name(full)

    def persistent_load(self, pid: Any) -> Made:
        self.persistent_ids.append(pid)
        return Made(PERSISTENT_ID, (pid,))

    def load_empty(self, name: str) -> None:
        self.append(Made(name, ()))

    def load_filled_dictionary(self) -> None:
        items = self.pop_mark()
        if len(items) % 2:
            raise UnsafeFileError("a dictionary with a key that has no value")
        self.append(Made(DICTIONARY, (), items=items))

    def load_call(self) -> None:
        args, name = self.stack.pop(), self.stack.pop()
        if not (isinstance(name, Name) and isinstance(args, tuple)):
            raise UnsafeFileError("a pickle that calls something that is not a name")
        if name.name == _NEW_OBJECT and args and isinstance(args[0], Name):
            name, args = args[0], ()  # the rest are a base class and its state, of no use
        self.append(Made(name.name, args))

    def load_state(self) -> None:
        state, top = self.stack.pop(), self.stack[-1]
        if not isinstance(top, Made) or top.state is not None:
            raise UnsafeFileError("a pickle that sets the state of an object that is not new")
        top.state = state

    # Hashing the keys of a dictionary could take for ever. No file needs a set, but `VecNormalize`
    # may have one inside.
    dispatch[pickle.EMPTY_DICT[0]] = partial(load_empty, name=DICTIONARY)
    dispatch[pickle.EMPTY_SET[0]] = partial(load_empty, name="set")
    dispatch[pickle.DICT[0]] = load_filled_dictionary
    dispatch[pickle.REDUCE[0]] = dispatch[pickle.NEWOBJ[0]] = load_call
    dispatch[pickle.BUILD[0]] = load_state


# --- building the recorded objects ----------------------------------------------------------------

Maker = Callable[[Made, "Build"], Any]


@dataclass
class Build:
    """Builds values from records, a shared part at each of its places, by tables of full names."""

    makers: Mapping[str, Maker]
    classes: Mapping[str, type]
    budget: Budget
    depth: int = 0

    def __call__(self, tree: Any) -> Any:
        """Build a part of the tree; a part that contains itself is too deep."""
        n_bytes = len(tree) if isinstance(tree, str | bytes | bytearray) else 0
        self.budget.charge(_PRICE + n_bytes)
        if isinstance(tree, Name | Made | list | tuple):
            self.depth += 1
            if self.depth > MAX_DEPTH:
                raise UnsafeFileError(f"is nested more than {MAX_DEPTH} deep")
            tree = self._make(tree)
            self.depth -= 1
        return tree

    def _make(self, tree: Any) -> Any:
        if isinstance(tree, list | tuple):
            return type(tree)(map(self, tree))
        if tree.name == DICTIONARY:
            return {key: self(value) for key, value in pairs(tree)}
        table: Mapping[str, Any] = self.classes if isinstance(tree, Name) else self.makers
        if tree.name not in table:
            name = shown(tree.name).strip("'")
            raise UnsafeFileError(f"holds {name}, which may not stand in such a file")
        if isinstance(tree, Name):
            return table[tree.name]
        try:
            return table[tree.name](tree, self)
        except UnsafeFileError:
            raise
        except Exception as error:  # the libraries' constructors can fail in any way
            raise wrong(tree) from error


# --- helpers for makers ---------------------------------------------------------------------------


def pairs(made: Made) -> Iterator[tuple[Any, Any]]:
    """The keys of a dictionary, which are texts and small numbers, and its recorded values."""
    for key, value in zip(made.items[::2], made.items[1::2], strict=True):
        if not isinstance(key, str | int) or (isinstance(key, int) and abs(key) >= END_OF_KEYS):
            raise UnsafeFileError("uses something other than texts and numbers as keys")
        yield key, value


def fields(made: Made, build: Build, only: tuple[str, ...] | None = None) -> dict[str, Any]:
    """The recorded attributes of an object, or only those of these names."""
    if made.args or made.items or not (made.state is None or made.state.name == DICTIONARY):
        raise wrong(made)
    known = () if made.state is None else pairs(made.state)
    return {name: build(value) for name, value in known if only is None or name in only}


def wrong(made: Made) -> UnsafeFileError:
    """The error for an object whose contents differ from genuine files."""
    name = shown(made.name).strip("'")
    return UnsafeFileError(f"holds a {name} that is not as the library writes it")
