"""What objects share with each other: memory, closures, methods, sources of random bits."""

import enum
import io
from collections import Counter, OrderedDict, defaultdict, deque

import numpy as np
import pytest

from snapshots.filling import NotRestorableError
from snapshots.kinds import NotRecordableError
from snapshots.recording import record
from snapshots.restoring import restore


class Thing:
    """Anything, by name."""

    def __init__(self, **held):
        vars(self).update(held)

    def one(self):
        return 1

    def two(self):
        return 2


class Row(list):
    pass


class Grid(np.ndarray):
    pass


class Side(enum.Flag):
    LEFT = 1
    RIGHT = 2


def poured(original, other):
    restore(record({"it": original}), {"it": other})
    return other


def tables():
    table = np.zeros((3, 2))
    return Thing(table=table, row=table[0])


def test_a_row_of_a_table_is_that_row_again():
    original = tables()
    original.table[...] = np.arange(6).reshape(3, 2)
    original.row = original.table[2]
    other = poured(original, tables())
    assert other.table.tolist() == [[0, 1], [2, 3], [4, 5]]
    other.row += 10
    assert other.table.tolist() == [[0, 1], [2, 3], [14, 15]]


def test_a_row_of_its_own_writes_into_no_table():
    original = tables()
    original.row = np.ones(2)
    other = poured(original, tables())
    assert other.table.sum() == 0
    other.row += 1
    assert other.table.sum() == 0


def test_views_backwards_and_read_only():
    original = tables()
    original.row = original.table[::-1, 1]
    original.row.flags.writeable = False
    original.table[...] = np.arange(6).reshape(3, 2)
    other = poured(original, tables())
    assert other.row.tolist() == [5, 3, 1]
    assert np.shares_memory(other.row, other.table)
    assert not other.row.flags.writeable


def counting():
    count = 0

    def add():
        nonlocal count
        count += 1
        return count

    return Thing(add=add, read=lambda: count)


def test_what_a_function_has_closed_over():
    original = counting()
    original.add()
    original.add()
    other = poured(original, counting())
    assert other.add() == 3
    assert other.read() == 3


def test_a_method_that_was_put_in_place_of_another():
    original, other = Thing(), Thing()
    original.now, other.now = original.two, other.one
    assert poured(original, other).now() == 2
    assert other.now.__self__ is other


def test_another_lambda_is_not_taken_for_the_one_that_was_kept():
    with pytest.raises(NotRestorableError, match="<lambda>"):
        poured(Thing(f=lambda: 1), Thing(f=lambda: 2))


def test_two_generators_of_one_source():
    first = np.random.default_rng(3)
    original = Thing(first=first, second=np.random.Generator(first.bit_generator))
    other = poured(original, Thing(first=None, second=None))
    assert [other.first.random(), other.second.random()] == [
        original.first.random(),
        original.second.random(),
    ]


def test_classes_derived_from_containers_keep_what_they_add():
    row, grid = Row([1, 2]), np.arange(3).view(Grid)
    row.name, grid.name = "a", "b"
    masked = np.ma.masked_array([1.0, 2.0], [True, False])
    other = poured(Thing(held=[row, grid, masked]), Thing(held=[]))
    assert [type(held) for held in other.held] == [Row, Grid, np.ma.MaskedArray]
    assert (other.held[0], other.held[0].name, other.held[1].name) == ([1, 2], "a", "b")
    assert other.held[2].mask.tolist() == [True, False]


def test_containers_that_were_made_since():
    held = [Counter("aab"), OrderedDict(b=1, a=2), defaultdict(list, a=[1]), deque([1], maxlen=2)]
    held[1].move_to_end("b")
    other = poured(Thing(held=held), Thing(held=[]))
    assert repr(other.held) == repr(held)


def test_flags_of_several():
    both = Side.LEFT | Side.RIGHT
    assert poured(Thing(held=[both, Side(0)]), Thing(held=[None, None])).held == [both, Side(0)]


@pytest.mark.parametrize("make", [io.BytesIO, io.StringIO])
def test_files_that_are_read_are_refused(make):
    with pytest.raises(NotRecordableError, match=r"io\."):
        record({"it": Thing(held=make())})


def test_data_of_a_library_for_games_is_refused():
    import pygame

    for held in (pygame.Rect(0, 0, 1, 1), pygame.math.Vector2(1, 2)):
        with pytest.raises(NotRecordableError, match="pygame"):
            record({"it": Thing(held=held)})
