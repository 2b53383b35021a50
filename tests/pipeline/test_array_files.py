"""Archives of arrays: those that NumPy writes are read, and no other."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as np_st

from pipeline.digests import DamagedFileError, read_arrays

PATH = Path("run/evaluations.npz")


def archive(save=np.savez, **arrays):
    stream = io.BytesIO()
    save(stream, **arrays)
    return stream.getvalue()


def zipped(members, **options):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", **options) as file:
        for name, content in members:
            file.writestr(name, content)
    return stream.getvalue()


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


@given(
    array=np_st.arrays(
        st.sampled_from(["?", "i1", "<u4", ">i8", "<f2", ">f8"]), np_st.array_shapes(min_dims=0)
    ),
    is_fortran=st.booleans(),
    save=st.sampled_from([np.savez, np.savez_compressed]),
)
def test_what_numpy_writes_is_read_as_numpy_does(array, is_fortran, save):
    array = np.asfortranarray(array) if is_fortran and array.ndim else array
    (found,) = read_arrays(PATH, archive(save, a=array)).values()
    assert found.dtype == array.dtype
    assert found.flags.writeable
    assert np.array_equal(found, array, equal_nan=array.dtype.kind == "f")


def test_empty_arrays():
    found = read_arrays(PATH, archive(a=np.empty((0, 3)), b=np.arange(2)))
    assert found["a"].shape == (0, 3)
    assert found["b"].tolist() == [0, 1]


def header(shape):
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


GOOD = npy(np.arange(3.0))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not a zip file"),
        (b"PK\x03\x04", "not a zip file"),
        (archive(a=np.arange(9))[:-30], "not a zip file"),
        (archive(a=np.array([{}], object)), "Object arrays cannot be loaded"),
        (archive(a=np.array(["text"])), "where numbers belong"),
        (archive(a=np.array([1j])), "complex128 where numbers belong"),
        (archive(a=np.zeros(1, "M8[s]")), "where numbers belong"),
        (archive(a=np.zeros(1, [("x", "f8")])), "where numbers belong"),
        (zipped([("a.txt", b"")]), "what is no array"),
        (zipped([("a.npy", b"")]), "what is no array"),
        (zipped([("a.npy", b"\x93NUMPY\x03\x00")]), "EOF"),
        (zipped([("a.npy", header("(1000000000000,)"))]), "Unable to allocate|EOF"),
        (zipped([("a.npy", header("(9000,)") + bytes(8))]), "EOF"),
        (zipped([("a.npy", header("(-1,)") + bytes(8))]), "negative"),
        (zipped([("a.npy", header("(1L,)") + bytes(8))]), "Python 2"),
        (zipped([("a.npy", header("(1") + bytes(8))]), "parse|EOF"),
        (zipped([("a.npy", GOOD)], compression=zipfile.ZIP_BZIP2), "compressed in a way"),
        (zipped([(f"{i}.npy", GOOD) for i in range(1001)]), "too many of them"),
    ],
)
def test_anything_else_is_refused_in_one_line(content, reason):
    with pytest.raises(DamagedFileError, match=reason) as caught:
        read_arrays(PATH, content)
    assert str(caught.value).startswith("run/evaluations.npz is damaged: ")


def test_a_wrong_checksum_is_noticed():
    content = bytearray(archive(a=np.arange(99.0)))
    content[600] ^= 1
    with pytest.raises(DamagedFileError, match="CRC"):
        read_arrays(PATH, bytes(content))


def test_a_bomb_is_not_unpacked():
    small = archive(np.savez_compressed, a=np.zeros(1_000_000))
    assert read_arrays(PATH, small)["a"].size == 1_000_000
    bomb = archive(np.savez_compressed, a=np.zeros(10_000_000))
    with pytest.raises(DamagedFileError, match="would take more memory than 4 times its"):
        read_arrays(PATH, bomb)
    # One that is stored as it is may be of any size.
    assert read_arrays(PATH, archive(a=np.zeros(10_000_000)))["a"].size == 10_000_000
