"""From the tree of a pickle to objects, by a fixed table of what may stand in such a file."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from safe_files.limits import MAX_DEPTH, Budget
from safe_files.pickle_trees import PLAIN, Made, Name, Tree, parts_of
from safe_files.refusals import UnsafeFileError, shown

Build = Callable[[Tree], Any]
Maker = Callable[[Made, Build], Any]

# What a value takes, with its place in what holds it; texts and bytes take their length besides.
_BYTES_PER_VALUE = 32
# Makers of spaces make several arrays of each that they are given; others a copy.
_SPACES, _COPIES_OF_A_SPACE = "gymnasium.spaces.", 4
_REFUSED = "which may not stand in such a file"


@dataclass(frozen=True)
class Admitted:
    """What a file may hold beside plain data, by the full names of classes and functions."""

    makers: Mapping[str, Maker]  # what makes an object, and refuses what does not fit
    classes: Mapping[str, type]  # those that a file may name
    holders: Collection[str] = ()  # makers that copy nothing of what they are given


def rebuild(tree: Tree, admitted: Admitted, budget: Budget) -> Any:
    """Make what a tree stands for."""
    rebuilding = _Rebuilding(admitted, budget)
    try:
        size, _ = rebuilding.measure(tree)
    except RecursionError:
        raise UnsafeFileError(f"is nested more than {MAX_DEPTH} deep") from None
    if not isinstance(tree, Made):
        # Whoever writes it out, or compares it, meets what is shared at each of its places.
        budget.charge(size)
    return rebuilding.build(tree)


class _Rebuilding:
    """What has been made so far; that which is shared in the tree is made once."""

    def __init__(self, admitted: Admitted, budget: Budget) -> None:
        self.admitted = admitted
        self.budget = budget
        self.measures: dict[int, tuple[int, int]] = {}
        self.made: dict[int, Any] = {}
        self.under_way: set[int] = set()

    def measure(self, tree: Tree) -> tuple[int, int]:
        """Bytes of a part, what is shared counted at each of its places; and how deep it is."""
        if isinstance(tree, PLAIN):
            return _BYTES_PER_VALUE + (len(tree) if isinstance(tree, str | bytes) else 0), 0
        key = id(tree)
        if key not in self.measures:
            # What refers to itself is refused where it is built.
            self.measures[key] = 0, 0
            found = [self.measure(part) for part in parts_of(tree)]
            depth = 1 + max((depth for _, depth in found), default=0)
            if depth > MAX_DEPTH:
                raise UnsafeFileError(f"is nested more than {MAX_DEPTH} deep")
            self.measures[key] = _BYTES_PER_VALUE + sum(size for size, _ in found), depth
        return self.measures[key]

    def build(self, tree: Tree) -> Any:
        """Make one part of the tree."""
        if isinstance(tree, PLAIN):
            return tree
        key = id(tree)
        if key in self.under_way:
            raise UnsafeFileError("refers to itself")
        if key not in self.made:
            self.under_way.add(key)
            self.made[key] = self._make(tree)
            self.under_way.remove(key)
        return self.made[key]

    def _make(self, tree: Tree) -> Any:
        match tree:
            case list() | tuple() | set():
                self.budget.charge(2 * _BYTES_PER_VALUE + 8 * len(tree))
                return type(tree)(self.build(item) for item in tree)
            case dict():
                self.budget.charge(_BYTES_PER_VALUE * (2 + 3 * len(tree)))
                return {self.build(key): self.build(value) for key, value in tree.items()}
            case Name():
                return self._named(tree)
            case Made():
                maker = self.admitted.makers.get(canonical(tree.maker))
                if maker is None:
                    raise UnsafeFileError(f"holds {_what(tree.maker)}, {_REFUSED}")
                if str(tree.maker) not in self.admitted.holders:
                    n_copies = _COPIES_OF_A_SPACE if str(tree.maker).startswith(_SPACES) else 1
                    self.budget.charge(n_copies * self.measures[id(tree)][0])
                try:
                    return maker(tree, self.build)
                except UnsafeFileError:
                    raise
                except Exception as error:  # the libraries' constructors can fail in any way
                    raise wrong(tree) from error
        raise UnsafeFileError("holds what is no data")

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
    """The arguments of a call, which must be of these kinds, and nothing besides them."""
    values = tuple(build(arg) for arg in made.args)
    fits = len(values) == len(kinds) and all(map(isinstance, values, kinds))
    if not fits or made.state is not None or made.items or made.pairs:
        raise wrong(made)
    return values


def fields(made: Made, build: Build) -> dict[str, Any]:
    """The attributes that an object is given."""
    state = {} if made.state is None else build(made.state)
    fits = isinstance(state, dict) and all(isinstance(key, str) for key in state)
    if not fits or made.args or made.items or made.pairs:
        raise wrong(made)
    return dict(state)


def chosen_fields(made: Made, build: Build, names: Iterable[str]) -> dict[str, Any]:
    """Those of an object's attributes that are asked for; the others are not looked at."""
    trees = made.state if isinstance(made.state, dict) else {}
    if not trees.keys() >= set(names):
        raise wrong(made)
    return {name: build(trees[name]) for name in names}


def wrong(made: Made) -> UnsafeFileError:
    """The refusal of an object that is not given what genuine files give it."""
    return UnsafeFileError(f"holds a {_what(made.maker)} that is not as the library writes it")
