"""Files of tensors: read as the numbers that they hold, each of which lies in the file.

PyTorch's own reader believes what a file says of its tensors: a few bytes can stand for any number
of elements. Here a tensor is made of the bytes of its storage, and shows each of them at most once.
"""

from __future__ import annotations

import io
import zipfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
import torch as th

from safe_files.archives import opened_zip
from safe_files.limits import MAX_DIMENSIONS, Budget
from safe_files.pickle_trees import INSTRUCTIONS, Made, Name, TreeReader, instructions
from safe_files.rebuilding import Admitted, Build, Maker, rebuild, wrong
from safe_files.refusals import UnsafeFileError, shown

_STORAGE = Name("torch.storage", "TypedStorage")
_DTYPES: Mapping[str, th.dtype] = {
    "torch.BoolStorage": th.bool,
    "torch.ByteStorage": th.uint8,
    "torch.CharStorage": th.int8,
    "torch.ShortStorage": th.int16,
    "torch.IntStorage": th.int32,
    "torch.LongStorage": th.int64,
    "torch.HalfStorage": th.float16,
    "torch.BFloat16Storage": th.bfloat16,
    "torch.FloatStorage": th.float32,
    "torch.DoubleStorage": th.float64,
    "torch.ComplexFloatStorage": th.complex64,
    "torch.ComplexDoubleStorage": th.complex128,
}


class TensorReader(TreeReader):
    """Reads pickles of protocol 2, as PyTorch writes them: storages stand beside the pickle."""

    dispatch: ClassVar[dict[int, Any]] = instructions(
        INSTRUCTIONS | {"GLOBAL", "BINPUT", "LONG_BINPUT", "BINPERSID"}
    )

    def __init__(self, file: io.BytesIO, budget: Budget) -> None:
        super().__init__(file, budget)
        self.storages: dict[Any, Made] = {}

    def persistent_load(self, pid: Any) -> Made:
        """Note down a storage; the same one, where a file says it twice."""
        _, kind, key, _, size, *_ = pid
        return self.storages.setdefault((str(kind), str(key), size), Made(_STORAGE, tuple(pid)))


def load_tensors(content: bytes, budget: Budget | None = None) -> Any:
    """What a ``.pth`` file holds: tensors in dictionaries and lists.

    Args:
        content: the file.
        budget: pays for the tensors; None for that of such a file.

    Raises:
        UnsafeFileError: if it holds anything else, is damaged, or says more than it holds.
    """
    budget = budget or Budget(len(content))
    try:
        with opened_zip(content, budget) as archive:
            infos = archive.infolist()
            # PyTorch stores its records as they are; one that was deflated is a bomb.
            if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
                raise UnsafeFileError("compressed tensors, which PyTorch does not write")
            names = {info.filename.partition("/")[2]: info.filename for info in infos}
            if "data.pkl" not in names:
                raise UnsafeFileError("no pickle of tensors")
            order = archive.read(names["byteorder"]) if "byteorder" in names else b"little"
            if order != b"little":
                raise UnsafeFileError("numbers in another order of bytes")
            budget.charge(sum(info.file_size for info in infos))
            tree = TensorReader(io.BytesIO(archive.read(names["data.pkl"])), budget).load()

            def storage(made: Made, build: Build) -> th.Tensor:
                return flat(made, archive.read(names[f"data/{made.args[2]}"]))

            return rebuild(tree, Admitted({**MAKERS, str(_STORAGE): storage}, {}), budget)
    except UnsafeFileError as error:
        raise UnsafeFileError(f"holds tensors that cannot be read: {error}") from error


def flat(made: Made, content: bytes) -> th.Tensor:
    """The tensor of one dimension that a storage is."""
    _, kind, _, _, size, *_ = made.args
    dtype = _DTYPES[str(kind)]
    if size * dtype.itemsize != len(content):
        raise UnsafeFileError(f"a storage of {len(content):,} bytes that says it has {shown(size)}")
    tensor = th.empty(size, dtype=dtype)
    tensor.view(th.uint8).numpy()[:] = np.frombuffer(content, np.uint8)
    return tensor


def lone_storage(content: bytes, budget: Budget) -> th.Tensor:
    """A storage in a file of its own, as PyTorch pickles it where tensors are in other pickles."""
    file = io.BytesIO(content)
    reader = TensorReader(file, budget)
    # Before it are three marks of the format, and behind it the list of the storages and its size.
    made = [reader.load() for _ in range(5)][3]
    return flat(made, file.read()[8:])


def _tensor(made: Made, build: Build) -> th.Tensor:
    """A view of a storage in which no two elements lie at the same place."""
    storage, offset, shape, strides, requires_grad = (build(arg) for arg in made.args[:5])
    is_tensor = isinstance(storage, th.Tensor) and len(shape) <= MAX_DIMENSIONS
    if made.state is not None or len(made.args) > 7 or not is_tensor:
        raise wrong(made)
    end = 1
    for stride, size in sorted(zip(strides, shape, strict=True)):
        if size > 1 and stride < end:
            raise UnsafeFileError("a tensor that shows numbers of its storage several times")
        end += stride * (size - 1)
    if min((offset, *shape, *strides)) < 0 or (0 not in shape and offset + end > len(storage)):
        raise UnsafeFileError("a tensor that is larger than its storage")
    tensor: th.Tensor = storage.as_strided(shape, strides, offset)
    return tensor.requires_grad_(bool(requires_grad))


def _parameter(made: Made, build: Build) -> th.nn.Parameter:
    tensor, requires_grad, _ = (build(arg) for arg in made.args)
    return th.nn.Parameter(tensor, bool(requires_grad))


def _state_dict(made: Made, build: Build) -> dict[str, Any]:
    """An OrderedDict; what PyTorch says of the versions of a network's parts is left out."""
    if made.args or made.items or not all(isinstance(key, str) for key, _ in made.pairs):
        raise wrong(made)
    return OrderedDict((key, build(value)) for key, value in made.pairs)


MAKERS: Mapping[str, Maker] = {
    "collections.OrderedDict": _state_dict,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": _parameter,
}


def check_values(files: Mapping[str, Any]) -> None:
    """Make sure that all tensors are finite numbers."""
    for name, content in files.items():
        for path, tensor in tensors_in(content):
            where = f"{name}: {shown(path)[1:-1]}"
            if tensor.is_complex() or tensor.is_quantized or tensor.layout != th.strided:
                raise UnsafeFileError(f"{where} is not made of real numbers")
            if tensor.is_floating_point() and not bool(th.isfinite(tensor).all()):
                raise UnsafeFileError(f"{where} holds numbers that are not finite")


def tensors_in(content: Any, path: str = "") -> Iterator[tuple[str, th.Tensor]]:
    """The tensors in nested dictionaries and lists, each with the way to it."""
    if isinstance(content, th.Tensor):
        yield path, content
        return
    items: Any = ()
    if isinstance(content, dict):
        items = content.items()
    elif isinstance(content, list | tuple):
        items = enumerate(content)
    for key, value in items:
        yield from tensors_in(value, f"{path}.{key}" if path else str(key))


def first_line(error: BaseException) -> str:
    """What a foreign exception says before it gives advice, or its kind where it says nothing."""
    lines = str(error).strip().splitlines()
    # PyTorch says below a heading which tensor it is.
    n_lines = 2 if lines and lines[0].endswith(":") else 1
    text = " ".join(line.strip() for line in lines[:n_lines])
    return text.partition(". ")[0] or type(error).__name__
