"""Pickles as data: the tree is what Python's own unpickler makes, where that is harmless."""

import contextlib
import io
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rl_yardstick.safe_files.files import Budget, UnsafeFileError
from rl_yardstick.safe_files.known_objects import read_pickle
from rl_yardstick.safe_files.pickles import Made, Name, Reader

KEYS = st.text(max_size=5) | st.integers(-(2**60), 2**60)
VALUES = st.recursive(
    KEYS | st.binary(max_size=5) | st.none() | st.booleans() | st.floats(allow_nan=False),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(KEYS, inner, max_size=4)
    ),
    max_leaves=20,
)


@settings(max_examples=30)
@given(VALUES, st.integers(4, 5))
def test_plain_data_comes_out_as_it_went_in(value, protocol):
    assert read_pickle(pickle.dumps(value, protocol)) == value


@given(VALUES, st.data())
def test_cut_off_pickles_are_refused(value, data):
    whole = pickle.dumps(value)
    length = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(UnsafeFileError):
        read_pickle(whole[:length])


@given(st.binary(max_size=40))
def test_any_bytes_are_data_or_refused(content):
    with contextlib.suppress(UnsafeFileError):
        read_pickle(content)


def test_calls_and_names_are_written_down_and_not_made():
    class Loud:
        def __reduce__(self):
            return print, ("called",)

    call, name = Reader(io.BytesIO(pickle.dumps([Loud(), int])), Budget(0)).load()
    assert isinstance(call, Made)
    assert (call.name, call.args) == ("builtins.print", ("called",))
    assert name == Name("builtins.int")


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 2, 0)])
def test_arrays_come_out_as_they_went_in(axes):
    """Pictures with their channels in front are views with the axes in another order."""
    array = np.arange(24, dtype=np.uint8).reshape(2, 3, 4).transpose(axes)
    found = read_pickle(pickle.dumps(array))
    assert (found.dtype, found.tolist()) == (array.dtype, array.tolist())
