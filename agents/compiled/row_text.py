"""Rows of Monitor's files as text, written by compiled code where returns are whole numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from machine_code.compiling import inlined, kernel
from mdp.array_types import Floats, Ints

MOST_DIGITS = 19
# Python writes larger whole numbers with an exponent.
LARGEST = 1e15
COMMA, MINUS, POINT, ZERO = b",-.0"

Bytes = NDArray[np.uint8]


def whole_rows(returns: Floats, lengths: Ints, end: str) -> str | None:
    """A row ``<return>.0,<length>,<end>`` for each episode; None where a return is not whole.

    Args:
        returns: of the episodes, shape (n,).
        lengths: numbers of their steps, shape (n,).
        end: what all rows end with, in ASCII.
    """
    room = np.empty(len(returns) * (2 * MOST_DIGITS + len(end) + 5), dtype=np.uint8)
    n_bytes = _write_all(returns, lengths, np.frombuffer(end.encode("ascii"), np.uint8), room)
    return None if n_bytes < 0 else room[:n_bytes].tobytes().decode("ascii")


@kernel
def _write_all(returns: Floats, lengths: Ints, end: Bytes, room: Bytes) -> int:
    """Fill the room, and return how many bytes there are; -1 where a return is not whole."""
    place = 0
    for i in range(len(returns)):
        if not abs(returns[i]) < LARGEST or returns[i] != np.floor(returns[i]):
            return -1
        whole = int(returns[i])
        if whole < 0:
            room[place] = MINUS
            place += 1
        place = _write_number(abs(whole), room, place)
        room[place] = POINT
        room[place + 1] = ZERO
        room[place + 2] = COMMA
        place = _write_number(lengths[i], room, place + 3)
        room[place] = COMMA
        place += 1
        for k in range(len(end)):
            room[place + k] = end[k]
        place += len(end)
    return place


@inlined
def _write_number(number: int, room: Bytes, place: int) -> int:
    """Write a number that is not negative, and return the place behind it."""
    n_digits, power = 1, 10
    while number >= power:
        n_digits += 1
        power *= 10
    for k in range(n_digits - 1, -1, -1):
        room[place + k] = ZERO + number % 10
        number //= 10
    return place + n_digits
