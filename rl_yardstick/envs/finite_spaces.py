"""Finite spaces of Gymnasium as the numbers from 0 on, and back.

A member of a finite space is a row of whole numbers, its *digits*: one for Discrete, one for each
entry of MultiDiscrete, MultiBinary and a Box of whole numbers, and those of all parts for Tuple and
Dict. The last digit counts fastest.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import reduce
from operator import getitem
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from rl_yardstick.mdp.transition_model import Ints

Space = spaces.Space[Any]

# The largest space that is numbered without being asked: a model file holds no larger one.
MOST_MEMBERS = 10_000_000
_BEYOND = 1 << 63  # numbers are of 64 bits


class Bijection:
    """Numbers the members of a finite space from 0 to n - 1.

    A batch of members is what a VecEnv gives: arrays whose first axis counts the members, in a
    dictionary for Dict and a tuple for Tuple.

    Args:
        space: Discrete, MultiDiscrete, MultiBinary, a bounded Box of whole numbers, or a Tuple or
            Dict of such spaces, also nested.

    Attributes:
        space: the space.
        numbers_space: the space of the numbers, ``Discrete(n)``.

    Raises:
        ValueError: if the space is not finite, or has 2 ** 63 members or more.
    """

    def __init__(self, space: Any) -> None:
        self.space = space
        leaves = list(_leaves(space))
        self._paths = [path for path, _ in leaves]
        self._ranges = [ends for _, leaf in leaves for ends in _ranges(leaf)]
        steps, n = list[int](), 1
        for size, first in reversed(self._ranges):
            steps.append(n)
            n *= size
            if not 0 < n < _BEYOND or not -_BEYOND <= first < _BEYOND - size:
                raise ValueError(f"{describe(space)} has too many members")
        self.numbers_space = spaces.Discrete(n)
        rows = [(*ends, step) for ends, step in zip(self._ranges, reversed(steps), strict=True)]
        self._digits = np.array(rows, np.int64).reshape(len(rows), 3)

    def _values(self, members: Any) -> list[Any]:
        """What a member or a batch holds for each space that has no parts."""
        try:
            return [reduce(getitem, path, members) for path in self._paths]
        except (LookupError, TypeError):
            raise _not_in(self.space, members) from None

    def digits_of(self, member: Any) -> list[Any]:
        """The digits of one member, not checked; ValueError if there are too many or too few."""
        digits = list[Any]()
        for value in self._values(member):
            digits += [value] if isinstance(value, int) else np.ravel(value).tolist()
        if len(digits) != len(self._ranges):
            raise _not_in(self.space, member)
        return digits

    def number(self, member: Any) -> int:
        """The number of one member; ValueError if it is not in the space."""
        index, digits = 0, self.digits_of(member)
        for digit, (size, first) in zip(digits, self._ranges, strict=True):
            place = int(digit) - first
            if not 0 <= place < size or digit != place + first:
                raise _not_in(self.space, member)
            index = index * size + place
        return index

    def numbers(self, batch: Any) -> Ints:
        """The numbers of a batch of members, shape (n,); ValueError if one is not in the space.

        An array, or a list of members, holds the digits of each member in a row.
        """
        in_parts = isinstance(batch, dict | tuple)
        parts = self._values(batch) if in_parts else [batch]
        digits = np.concatenate([np.reshape(part, (len(part), -1)) for part in parts], axis=1)
        if digits.shape[1] != len(self._ranges):
            raise _not_in(self.space, digits[0].tolist())
        size, first, step = self._digits.T
        places = digits.astype(np.int64) - first
        outside = ((places < 0) | (places >= size) | (digits != places + first)).any(axis=1)
        if outside.any():
            raise _not_in(self.space, digits[outside.argmax()].tolist())
        numbers: Ints = places @ step
        return numbers

    def member(self, number: int) -> Any:
        """The member of a number."""
        return self.members(np.int64(number))

    def members(self, numbers: ArrayLike) -> Any:
        """The members of numbers of shape (n,), as a batch."""
        given = np.asarray(numbers, np.int64)
        digits = (given // step % size + first for size, first, step in self._digits)
        return _built(self.space, digits, given.shape)

    def is_batch(self, members: Any) -> bool:
        """Whether the argument is a batch of members, and not one member."""
        if isinstance(members, list) or not self._paths:
            return isinstance(members, list)
        leaf = reduce(getitem, self._paths[0], self.space)
        return np.ndim(self._values(members)[0]) > len(leaf.shape or ())


def bijection_of(space: Space, kept: Iterable[str] = ("Discrete",)) -> Bijection | None:
    """The bijection of a finite space with at most `MOST_MEMBERS` members; None for others.

    None too for the spaces whose class is named in ``kept``, if they count from 0.
    """
    if type(space).__name__ in kept and counts_from_zero(space):
        return None
    with suppress(ValueError):
        found = Bijection(space)
        return found if found.numbers_space.n <= MOST_MEMBERS else None
    return None


def counts_from_zero(space: Space) -> bool:
    """Whether each Discrete and MultiDiscrete in a space starts at 0, as one-hot encodings need."""
    return not any(np.any(getattr(leaf, "start", 0)) for _, leaf in _leaves(space))


def table_size(observations: Space, actions: Space) -> str:
    """The size of a table for finite observations, in words; empty if one is not finite."""
    try:
        n_states, n_actions = (Bijection(each).numbers_space.n for each in (observations, actions))
    except ValueError:
        return ""
    needed = 8e-9 * float(n_states) * float(n_actions)
    return f" of this size (a table of {n_states:.3g} x {n_actions} needs {needed:,.0f} GB)"


def describe(space: Space) -> str:
    """A space in at most 80 characters: ``Dict(agent: Box(2), target: Box(2))``."""
    return textwrap.shorten(_words(space), 80, placeholder=" ...")


def _words(space: Space) -> str:
    if isinstance(space, spaces.Dict):
        return f"Dict({', '.join(f'{key}: {_words(one)}' for key, one in space.spaces.items())})"
    if isinstance(space, spaces.Tuple):
        return f"Tuple({', '.join(map(_words, space.spaces))})"
    if isinstance(space, spaces.Box):
        return f"Box({'x'.join(map(str, space.shape))})"
    return str(space)


def _not_in(space: Space, member: Any) -> ValueError:
    return ValueError(f"{textwrap.shorten(str(member), 80)} is not in {describe(space)}")


def _leaves(space: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """The spaces that have no parts, each with the keys that lead to it."""
    if type(space) not in {spaces.Dict, spaces.Tuple}:
        yield path, space
        return
    is_dict = isinstance(space, spaces.Dict)
    for key, part in space.spaces.items() if is_dict else enumerate(space.spaces):
        yield from _leaves(part, (*path, key))


def _ranges(space: Any) -> Iterator[tuple[int, int]]:
    """The number of values of each digit, and the first of them."""
    kind = type(space)  # a model file holds no subclass
    if kind is spaces.Discrete:
        yield int(space.n), int(space.start)
    elif kind is spaces.MultiDiscrete:
        yield from zip(space.nvec.ravel().tolist(), space.start.ravel().tolist(), strict=True)
    elif kind is spaces.MultiBinary and math.prod(space.shape) < 63:
        yield from [(2, 0)] * math.prod(space.shape)
    elif kind is spaces.Box and np.issubdtype(space.dtype, np.integer):
        bounds = zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True)
        yield from ((high - low + 1, low) for low, high in bounds)
    else:
        raise ValueError(f"{space} is not finite, or too large")


def _built(space: Space, digits: Iterator[Any], before: tuple[int, ...]) -> Any:
    """A member or a batch, whose shape is ``before``, from digits of this shape."""
    if isinstance(space, spaces.Dict):
        return {key: _built(part, digits, before) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_built(part, digits, before) for part in space.spaces)
    shape = (*before, *(space.shape or ()))
    found: list[NDArray[Any]] = [next(digits) for _ in range(math.prod(space.shape or ()))]
    array = (np.stack(found, axis=-1) if found else np.zeros(0)).reshape(shape).astype(space.dtype)
    return array[()] if isinstance(space, spaces.Discrete) else array
