"""Makers of the objects that model files may contain, and the classes that they may name."""

from __future__ import annotations

import contextlib
import importlib
import io
import math
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common import buffers, noise, torch_layers
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch import nn, optim
from torch.distributions.transforms import AffineTransform, ComposeTransform, ExpTransform
from torch.nn.modules import activation

from rl_yardstick.safe_files import pickles
from rl_yardstick.safe_files.arrays import ARRAYS
from rl_yardstick.safe_files.files import Budget, UnsafeFileError, read_members, shown
from rl_yardstick.safe_files.pickles import Build, Made, Maker, fields, pairs, wrong


def by_name(classes: Iterable[type]) -> dict[str, type]:
    """Classes by their full names (module and qualified name)."""
    return {f"{cls.__module__}.{cls.__qualname__}": cls for cls in classes}


def filled(cls: Any, made: Made, build: Build) -> Any:
    """An object with the attributes in the file, as unpickling makes it; they hide no method."""
    state = fields(made, build)
    if any(callable(getattr(cls, name, None)) for name in state):
        raise wrong(made)
    new = cls.__new__(cls)
    getattr(new, "__setstate__", vars(new).update)(state)
    # Fails for spaces without the attributes that others need.
    assert new == new  # noqa: PLR0124
    return new


# --- NumPy's generators and classes ------------------------------------------------------------


def _generator(made: Made, build: Build) -> np.random.Generator:
    """A PCG64 generator: NumPy 2 pickles an inner generator, NumPy 1 its name and the state."""
    inner = made.args[0]
    state = inner.state if isinstance(inner, Made) else made.state
    generator = np.random.Generator(np.random.PCG64())
    # NumPy 2 adds the seeds, from which other generators can be spawned: they are left out.
    generator.bit_generator.state = build(state[0] if isinstance(state, tuple) else state)
    return generator


_CLASSES_OF_NUMPY: Mapping[str, type] = {
    f"numpy.{kind.__name__}": kind
    for kind in (np.ndarray, np.float32, np.float64, np.int64, np.int32, np.int8, np.uint8)
} | {"numpy.bool_": np.bool_, "numpy.bool": np.bool_}


# --- tensors --------------------------------------------------------------------------------------

# PyTorch's own reader unpickles classes, and a few bytes can declare a tensor of any size. Here a
# tensor of real numbers has no more elements than the bytes of its storage.
_DTYPES: Mapping[str, th.dtype] = {
    f"torch.{kind}Storage": getattr(th, kind.lower())
    for kind in ("Bool", "Short", "Int", "Long", "Half", "BFloat16", "Float", "Double")
} | {"torch.ByteStorage": th.uint8, "torch.CharStorage": th.int8}


_STREAM = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."  # its magic number, of PyTorch before 1.6


def load_tensors(content: bytes, budget: Budget | None = None) -> Any:
    """Load a ``.pth`` file: tensors in dictionaries and lists."""
    budget = budget or Budget(len(content))
    storages: dict[str, th.Tensor] = {}
    try:
        tree, members = _records(content, budget)

        def storage(made: Made, build: Build) -> th.Tensor:
            """A storage, which the file may name several times."""
            key = made.args[0][2]
            if not isinstance(key, str):  # hashing a nested tuple can take for ever
                raise wrong(made)
            if key not in storages:
                storages[key] = _flat(made.args[0], members.pop(f"data/{key}"))
            budget.charge(storages[key].nbytes)
            return storages[key]

        return Build({**_OF_TENSORS, pickles.PERSISTENT_ID: storage}, {}, budget)(tree)
    except Exception as error:  # a damaged file can fail anywhere
        raise UnsafeFileError(f"holds tensors that cannot be read: {error}") from error


def _records(content: bytes, budget: Budget) -> tuple[Any, dict[str, bytes]]:
    """The recorded tree of a ``.pth`` file, and its members: the storages by ``data/KEY``."""
    file = io.BytesIO(content)
    reader = pickles.Reader(file, budget)
    if content.startswith(_STREAM):  # five pickles, then a size and the bytes for each key
        budget.charge(len(content))
        _, _, _, tree, keys = (reader.load() for _ in range(5))
        kinds = {str(key): kind for _, kind, key, *_ in reader.persistent_ids if type(key) is str}
        members = {}
        for key in map(str, keys):
            size, width = int.from_bytes(file.read(8), "little"), _DTYPES[kinds[key].name].itemsize
            record = file.read(min(size, len(content)) * width)
            if len(record) != size * width:
                raise UnsafeFileError("a storage that is cut off")
            members[f"data/{key}"] = record
        return tree, members
    # The name of a member begins with that of a folder.
    records = read_members(content, budget).items()
    members = {name.partition("/")[2]: record for name, record in records}
    return pickles.Reader(io.BytesIO(members.get("data.pkl", b"")), budget).load(), members


def _flat(pid: Any, content: bytes) -> th.Tensor:
    """The storage of a persistent id as a one-dimensional tensor."""
    _, kind, _, _, size, *_ = pid
    dtype = _DTYPES[kind.name]
    if size * dtype.itemsize != len(content):
        raise UnsafeFileError(f"a storage of {len(content):,} bytes for another size")
    tensor = th.empty(len(content) // dtype.itemsize, dtype=dtype)
    tensor.view(th.uint8).numpy()[:] = np.frombuffer(content, np.uint8)
    return tensor


def _tensor(made: Made, build: Build) -> th.Tensor:
    storage, offset, shape, strides, requires_grad = build(made.args[:5])
    if math.prod(shape) > len(storage):
        raise UnsafeFileError("a tensor that is larger than its storage")
    tensor: th.Tensor = storage.as_strided(shape, strides, offset)
    return tensor.requires_grad_(bool(requires_grad))


_OF_TENSORS: Mapping[str, Maker] = {
    # Without the versions of modules that PyTorch gives it.
    "collections.OrderedDict": lambda made, build: OrderedDict(
        (key, build(value)) for key, value in pairs(made)
    ),
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": lambda made, build: build(made.args[0]),
    # A lone storage in a stream, as PyTorch writes those of tensors in other pickles.
    "torch.storage._load_from_bytes": lambda made, build: load_tensors(made.args[0], build.budget),
}


def tensors_in(content: Any, path: str = "") -> Iterator[tuple[str, th.Tensor]]:
    """The tensors in nested dictionaries and lists, each with its path."""
    if isinstance(content, th.Tensor):
        yield path, content
    is_list = isinstance(content, list | tuple)
    parts = enumerate(content) if is_list else content.items() if isinstance(content, dict) else ()
    for key, value in parts:
        yield from tensors_in(value, f"{path}.{key}" if path else str(key))


def check_values(files: Mapping[str, Any]) -> None:
    """Check that all numbers in files of tensors are finite."""
    for path, tensor in tensors_in(files):
        if tensor.is_floating_point() and not bool(th.isfinite(tensor).all()):
            raise UnsafeFileError(f"{shown(path)[1:-1]} holds numbers that are not finite")


# --- objects of Gymnasium, Stable-Baselines3, rl_zoo3, PyTorch and Python -------------------------

_FILLED = (
    *(ConstantSchedule, LinearSchedule, FloatSchedule),
    *(AffineTransform, ComposeTransform, ExpTransform),  # schedules such as exp(a + b x)
    noise.VectorizedActionNoise,
    *(spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary),
    *(spaces.Dict, spaces.Tuple, RunningMeanStd),
)
_NOISES = (noise.NormalActionNoise, noise.OrnsteinUhlenbeckActionNoise)
_CALLED = by_name([TrainFreq, TrainFrequencyUnit, GoalSelectionStrategy])


def _noise(cls: Any, made: Made, build: Build) -> Any:
    new = filled(cls, made, build)
    vars(new).setdefault("_dtype", np.float32)  # which the library lacked before version 1.7
    return new


_MAKERS: Mapping[str, Maker] = {
    **_OF_TENSORS,
    **ARRAYS,
    "numpy.random._pickle.__generator_ctor": _generator,
    # The legacy generator of Gym's spaces: Gymnasium's make a new one.
    "numpy.random._pickle.__randomstate_ctor": lambda made, build: None,
    "gym.utils.seeding.RandomNumberGenerator._generator_ctor": lambda made, build: None,
    **{name: partial(filled, cls) for name, cls in by_name(_FILLED).items()},
    **{name: partial(_noise, cls) for name, cls in by_name(_NOISES).items()},
    **{name: lambda made, build: _CALLED[made.name](*build(made.args)) for name in _CALLED},
    # The arguments are its contents, always empty, and its maximum length.
    "collections.deque": lambda made, build: deque(build(made.items), *build(made.args[1:2])),
    "rl_zoo3.utils.SimpleLinearSchedule": lambda made, build: AffineTransform(
        0.0, fields(made, build)["initial_value"]
    ),
    # Of recurrent agents up to version 2.3, which begin anew with each training.
    "sb3_contrib.common.recurrent.type_aliases.RNNStates": lambda made, build: build(made.args),
    "torch.device": lambda made, build: th.device("cpu"),  # the caller chooses
}


# --- classes that a file may name -----------------------------------------------------------------


@cache
def _library_classes() -> Mapping[str, type]:
    """Buffers, feature extractors, activations and optimizers, by their full names."""
    modules: list[object] = [buffers, torch_layers, activation, optim]
    with contextlib.suppress(ImportError):
        names = (f"sb3_contrib.common.{kind}.buffers" for kind in ("maskable", "recurrent"))
        modules += map(importlib.import_module, names)
    kinds = (buffers.BaseBuffer, nn.Module, optim.Optimizer)
    members = (cls for module in modules for cls in vars(module).values() if isinstance(cls, type))
    found = [cls for cls in members if issubclass(cls, kinds)]
    return {**_CLASSES_OF_NUMPY, **by_name([*found, HerReplayBuffer, RMSpropTFLike, nn.Identity])}


def read_pickle(
    pickled: bytes,
    classes: Mapping[str, type] | None = None,
    makers: Mapping[str, Maker] | None = None,
    budget: Budget | None = None,
) -> Any:
    """Build the value of a pickle without unpickling; arguments allow further objects."""
    budget = budget or Budget(len(pickled))
    tree = pickles.Reader(io.BytesIO(pickled), budget).load()
    build = Build({**_MAKERS, **(makers or {})}, {**_library_classes(), **(classes or {})}, budget)
    return build(tree)
