"""Files of tensors: loaded as tensors alone, and held against what weights can be."""

from __future__ import annotations

import io
import pickle
import re
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import torch as th

from safe_files.archives import check_tensors
from safe_files.refusals import UnsafeFileError, shown

# An optimizer's file has four levels of dictionaries and lists.
_MOST_LEVELS = 20


def load_tensors(content: bytes) -> Any:
    """What a ``.pth`` file holds: tensors in dictionaries and lists.

    Raises:
        UnsafeFileError: if it holds anything else, is damaged, or unpacks to too much.
    """
    check_tensors(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return th.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file can fail anywhere in the library
        # PyTorch goes on to say how to have the code run.
        if isinstance(error, pickle.UnpicklingError) or "weights_only" in str(error):
            named = re.search(r"GLOBAL (\S+)", str(error))
            what = f": {shown(named[1])[1:-1]}" if named else ", or is damaged"
            raise UnsafeFileError(f"holds something else than tensors{what}") from error
        raise UnsafeFileError(f"holds tensors that cannot be read: {first_line(error)}") from error


def check_values(files: Mapping[str, Any]) -> None:
    """Make sure that all tensors are finite numbers.

    Args:
        files: what files of tensors hold, by their names.

    Raises:
        UnsafeFileError: if one is not; it names the tensor.
    """
    for name, content in files.items():
        for path, tensor in tensors_in(content):
            where = f"{name}: {shown(path)[1:-1]}"
            is_plain = tensor.layout == th.strided and not (tensor.is_nested or tensor.is_meta)
            if tensor.is_complex() or tensor.is_quantized or not is_plain:
                raise UnsafeFileError(f"{where} is not made of real numbers")
            if tensor.is_floating_point() and not bool(th.isfinite(tensor).all()):
                raise UnsafeFileError(f"{where} holds numbers that are not finite")


def tensors_in(content: Any, path: str = "", level: int = 0) -> Iterator[tuple[str, th.Tensor]]:
    """The tensors in nested dictionaries and lists, each with the way to it."""
    if level > _MOST_LEVELS:
        raise UnsafeFileError("nests dictionaries and lists deeper than agents do")
    if isinstance(content, th.Tensor):
        yield path, content
        return
    items: Any = ()
    if isinstance(content, dict):
        items = content.items()
    elif isinstance(content, list | tuple):
        items = enumerate(content)
    for key, value in items:
        yield from tensors_in(value, f"{path}.{key}" if path else str(key), level + 1)


def first_line(error: BaseException) -> str:
    """What a foreign exception says before it gives advice, or its kind where it says nothing."""
    lines = str(error).strip().splitlines()
    # PyTorch says below a heading which tensor it is.
    n_lines = 2 if lines and lines[0].endswith(":") else 1
    text = " ".join(line.strip() for line in lines[:n_lines])
    return text.partition(". ")[0] or type(error).__name__
