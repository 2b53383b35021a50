"""From the tree of a pickle to objects, by a fixed table of what may stand in such a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from safe_files.limits import MAX_DEPTH, MAX_VALUES
from safe_files.pickle_trees import Grouped, Made, Mapped, Name, Tree
from safe_files.refusals import UnsafeFileError, shown

Build = Callable[[Tree], Any]
Maker = Callable[[Made, Build], Any]

# What dictionaries may be keyed by: the hash of a nested tuple can take for ever.
KEYS = (str, int, float, bytes, type(None))
_REFUSED = "which may not stand in such a file"


@dataclass(frozen=True)
class Admitted:
    """What a file may hold beside plain data.

    Attributes:
        makers: by the full name of a class or function, what makes the object from what the file
            says, and refuses what does not fit.
        classes: by their full names, classes that a file may name.
    """

    makers: Mapping[str, Maker]
    classes: Mapping[str, type]


def rebuild(tree: Tree, admitted: Admitted) -> Any:
    """Make what a tree stands for.

    Args:
        tree: as `safe_files.pickle_trees.read_tree` returns it.
        admitted: what it may hold beside plain data.

    Raises:
        UnsafeFileError: if it holds anything else, refers to itself, or is too deep or too large.
    """
    return _Rebuilding(admitted).build(tree)


class _Rebuilding:
    """What has been made so far; that which is shared in the tree is made once."""

    def __init__(self, admitted: Admitted) -> None:
        self.admitted = admitted
        self.n_values = 0
        self.depth = 0
        self.made: dict[int, tuple[Any, int]] = {}
        self.under_way: set[int] = set()

    def build(self, tree: Tree) -> Any:
        """Make one part of the tree."""
        if tree is None or isinstance(tree, bool | int | float | str | bytes):
            self._count(1)
            return tree
        key = id(tree)
        if key in self.made:
            value, n_values = self.made[key]
            self._count(n_values)
            return value
        if key in self.under_way:
            raise UnsafeFileError("refers to itself")
        before = self.n_values
        self._count(1)
        self.under_way.add(key)
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise UnsafeFileError(f"is nested more than {MAX_DEPTH} deep")
        value = self._make(tree)
        self.depth -= 1
        self.under_way.remove(key)
        self.made[key] = value, self.n_values - before
        return value

    def _count(self, n_values: int) -> None:
        self.n_values += n_values
        if self.n_values > MAX_VALUES:
            raise UnsafeFileError(f"holds more than {MAX_VALUES:,} values")

    def _make(self, tree: Tree) -> Any:
        match tree:
            case list() | tuple():
                return type(tree)(self.build(item) for item in tree)
            case Mapped():
                return {self._key(key): self.build(value) for key, value in tree.pairs}
            case Grouped():
                return {self._key(item) for item in tree.items}
            case Name():
                return self._named(tree)
            case Made():
                maker = self.admitted.makers.get(canonical(tree.maker))
                if maker is None:
                    raise UnsafeFileError(f"holds {_what(tree.maker)}, {_REFUSED}")
                try:
                    return maker(tree, self.build)
                except UnsafeFileError:
                    raise
                except Exception as error:  # the libraries' constructors can fail in any way
                    raise wrong(tree) from error
        raise UnsafeFileError("holds what is no data")

    def _key(self, tree: Tree) -> Any:
        key = self.build(tree)
        if type(key) not in KEYS:
            raise UnsafeFileError(f"uses a {type(key).__name__} as the key of a dictionary")
        return key

    def _named(self, name: Name) -> type:
        found = self.admitted.classes.get(canonical(name))
        if found is None:
            raise UnsafeFileError(f"refers to {_what(name)}, {_REFUSED}")
        return found


def canonical(name: Name | Made) -> str:
    """The full name, as the present versions of the libraries have it."""
    # NumPy 2 renamed its inner package.
    return str(name).replace("numpy.core.", "numpy._core.", 1)


def _what(name: Name | Made) -> str:
    if isinstance(name, Made):
        return "a call of what a call returns"
    return shown(str(name)).strip("'")


# --- what makers are written with ----------------------------------------------------------------


def arguments(made: Made, build: Build, *kinds: type | tuple[type, ...]) -> tuple[Any, ...]:
    """The arguments of a call, which must be of these kinds, and nothing besides them.

    Raises:
        UnsafeFileError: if they are others, or the object is given more than arguments.
    """
    values = tuple(build(arg) for arg in made.args)
    fits = len(values) == len(kinds) and all(map(isinstance, values, kinds))
    if not fits or made.state is not None or made.items or made.pairs:
        raise wrong(made)
    return values


def fields(made: Made, build: Build) -> dict[str, Any]:
    """The attributes that an object is given.

    Raises:
        UnsafeFileError: if it is given anything else, or attributes that are not names.
    """
    state = {} if made.state is None else build(made.state)
    fits = isinstance(state, dict) and all(isinstance(key, str) for key in state)
    if not fits or made.args or made.items or made.pairs:
        raise wrong(made)
    return dict(state)


def chosen_fields(made: Made, build: Build, names: Iterable[str]) -> dict[str, Any]:
    """Those of an object's attributes that are asked for; the others are not looked at.

    Raises:
        UnsafeFileError: if the object has no attributes, or one of these is missing.
    """
    pairs = made.state.pairs if isinstance(made.state, Mapped) else []
    trees = {key: value for key, value in pairs if isinstance(key, str)}
    if not trees.keys() >= set(names):
        raise wrong(made)
    return {name: build(trees[name]) for name in names}


def wrong(made: Made) -> UnsafeFileError:
    """The refusal of an object that is not given what genuine files give it."""
    return UnsafeFileError(f"holds a {_what(made.maker)} that is not as the library writes it")
