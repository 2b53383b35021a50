"""NumPy archives read as what they should be: numbers in arrays of the sizes that they declare.

`numpy.load` allocates what a header asks for, unpacks whatever a zip holds, and fails in many ways;
here each array's header is held against the bytes that follow it first.
"""

from __future__ import annotations

import io
import math
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from pipeline.errors import one_line
from pipeline.file_digests import DamagedFileError
from safe_files.archives import read_member
from safe_files.files import Budget

MOST_ARRAYS = 1000
_KINDS = "biuf"  # booleans, integers, floats
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_SUFFIX = ".npy"
_HEADERS: Any = {
    (1, 0): npy_format.read_array_header_1_0,
    (2, 0): npy_format.read_array_header_2_0,
}
# What the two libraries raise at files that are cut off, damaged, encrypted or unknown to them.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    OSError,
    ValueError,
    TypeError,
    SyntaxError,
    RuntimeError,
    EOFError,
    OverflowError,
    MemoryError,
    tokenize.TokenError,  # of headers that are read as if Python 2 had written them
    Warning,
)


def read_arrays(path: Path, content: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of an archive, by name.

    Args:
        path: of the file, for messages.
        content: the archive.

    Raises:
        DamagedFileError: if it is no whole archive, or holds anything but numbers.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive, warnings.catch_warnings():
            warnings.simplefilter("error")
            infos = archive.infolist()
            _check_members(infos, len(content))
            return {
                info.filename.removesuffix(_SUFFIX): _array(read_member(archive, info))
                for info in infos
            }
    except _DAMAGE as error:
        raise DamagedFileError(path, f"is damaged: {one_line(error)}") from error


def _check_members(infos: list[zipfile.ZipInfo], n_bytes: int) -> None:
    names = {info.filename for info in infos}
    if len(names) != len(infos) or len(infos) > MOST_ARRAYS:
        raise ValueError("it holds an array twice, or too many of them")
    if not all(name.endswith(_SUFFIX) for name in names):
        raise ValueError("it holds what is no array")
    if not all(info.compress_type in _METHODS for info in infos):
        raise ValueError("it is compressed in a way that is not read here")
    # The bytes, those without the header, and the array.
    Budget(n_bytes).charge(3 * sum(info.file_size for info in infos))


def _array(content: bytes) -> NDArray[Any]:
    stream = io.BytesIO(content)
    header = _HEADERS.get(npy_format.read_magic(stream))
    if header is None:
        raise ValueError("it has arrays of an unknown format")
    shape, is_fortran, dtype = header(stream)
    if dtype.kind not in _KINDS:
        raise ValueError(f"it holds {dtype} where numbers belong")
    if not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError(f"it has an array of shape {shape}")
    rest = content[stream.tell() :]
    if math.prod(shape) * dtype.itemsize != len(rest):
        raise ValueError("it has an array of another size than it says")
    if not rest:
        return np.empty(shape, dtype)
    return np.frombuffer(rest, dtype).reshape(shape, order="F" if is_fortran else "C").copy()
