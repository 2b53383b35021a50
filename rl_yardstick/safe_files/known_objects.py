"""Makers of the objects that model files may contain, each from checked values."""

from __future__ import annotations

import contextlib
import importlib
import io
import math
import operator
import zipfile
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache, partial
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common import buffers, torch_layers
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import (
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch import nn, optim
from torch.distributions.transforms import AffineTransform, ComposeTransform, ExpTransform
from torch.nn.modules import activation

from rl_yardstick.safe_files.archives import opened_zip, read_member
from rl_yardstick.safe_files.files import Budget, UnsafeFileError, shown
from rl_yardstick.safe_files.pickles import (
    PRICES,
    Build,
    Made,
    Maker,
    Name,
    Reader,
    arguments,
    fields,
    read_tree,
    wrong,
)

MAX_DIMENSIONS = 32
MAX_ROWS = 1_000_000_000  # of a buffer


def _called(make: Callable[..., Any], *kinds: type) -> Maker:
    """A maker that checks the types of the file's arguments, and calls ``make`` with them."""
    return lambda made, build: make(*arguments(made, build, *kinds))


def _of_state(make: Callable[..., Any], /, **kinds: tuple[type, ...]) -> Maker:
    """A maker from exactly these attributes, checked for types and finite numbers."""

    def maker(made: Made, build: Build) -> Any:
        state = fields(made, build)
        if state.keys() != kinds.keys():
            raise wrong(made)
        for name, value in state.items():
            numbers = np.asarray(value) if isinstance(value, _NUMBERS) else np.zeros(0)
            if not isinstance(value, kinds[name]) or not np.isfinite(numbers).all():
                raise wrong(made)
        return make(*(state[name] for name in kinds))

    return maker


# --- NumPy's types, arrays, numbers and generators ------------------------------------------------

_NUMBERS = (int, float, np.number, np.ndarray)
# Booleans, integers, floats; no texts, records, dates or Python objects.
_TYPES = frozenset(["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"])
_MAX_POOL = 64


def _dtype(made: Made, build: Build) -> np.dtype[Any]:
    code = made.args[0] if made.args else None
    state = made.state
    order = state[1] if isinstance(state, tuple) and len(state) > 1 else "="
    if code == "O8":
        return np.dtype(object)
    if code not in _TYPES or not isinstance(order, str) or order not in "<>=|":
        raise UnsafeFileError("holds an array of a type other than numbers")
    return np.dtype(str(code)).newbyteorder(order)  # type: ignore[arg-type]


def _array(data: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    shape = (shape,) if isinstance(shape, int) else shape
    fits = (
        isinstance(dtype, np.dtype)
        and isinstance(shape, tuple)
        and len(shape) <= MAX_DIMENSIONS
        and all(isinstance(n, int) and n >= 0 for n in shape)
        and order in {"C", "F"}
    )
    if not fits:
        raise UnsafeFileError("holds an array that is not as NumPy writes it")
    # Arrays of objects hold dictionaries and plain values, such as the infos of a replay buffer.
    kind, size = (list, 1) if dtype.hasobject else (bytes, dtype.itemsize)
    if not isinstance(data, kind) or len(data) != math.prod(shape) * size:
        raise UnsafeFileError("holds an array whose size does not match its data")
    if isinstance(data, bytes):
        # A copy, because an array on bytes is read-only.
        return np.frombuffer(data, dtype).reshape(shape, order=order).copy(order=order)
    flat = np.empty(len(data), dtype=object)
    for index, value in enumerate(data):
        flat[index] = value
    return flat.reshape(shape, order=order)


def _from_buffer(made: Made, build: Build) -> NDArray[Any]:
    kinds = (bytes, np.dtype, (tuple, int), str, tuple)
    data, dtype, shape, order, *axes = arguments(made, build, *kinds[: max(len(made.args), 4)])
    if not axes:
        return _array(data, dtype, shape, order)
    # Since NumPy 2.3, for an array with another memory order of its axes.
    return _array(data, dtype, shape, "C").transpose(axes[0])


def _state_of_five(made: Made, build: Build) -> tuple[Any, ...]:
    """Check NumPy's state of five parts of an array or a seed sequence."""
    state = build(made.state)
    if not (isinstance(state, tuple) and len(state) == 5) or made.items or made.pairs:
        raise wrong(made)
    return state


def _reconstructed(made: Made, build: Build) -> NDArray[Any]:
    _, shape, dtype, is_fortran, data = _state_of_five(made, build)
    return _array(data, dtype, shape, "F" if is_fortran else "C")


def _seed_sequence(made: Made, build: Build) -> np.random.SeedSequence:
    entropy, n_children, _, pool_size, spawn_key = _state_of_five(made, build)
    if not (isinstance(pool_size, int) and pool_size <= _MAX_POOL):
        raise wrong(made)
    counts = {"pool_size": pool_size, "n_children_spawned": n_children}
    return np.random.SeedSequence(entropy, spawn_key=spawn_key, **counts)


def _bit_generator(made: Made, build: Build) -> np.random.PCG64:
    state, seeds = build(made.state), None
    if isinstance(state, tuple) and len(state) == 2:
        state, seeds = state
    if not (seeds is None or isinstance(seeds, np.random.SeedSequence)):
        raise wrong(made)
    generator = np.random.PCG64(seeds)
    if state is not None:
        generator.state = cast(Any, state)
    return generator


def _generator(made: Made, build: Build) -> np.random.Generator:
    # Older files have the constructor of the inner generator as a second argument.
    inner = build(made.args[0]) if made.args else None
    if not isinstance(inner, np.random.PCG64):
        raise wrong(made)
    return np.random.Generator(inner)


_OF_NUMPY: Mapping[str, Maker] = {
    "numpy.dtype": _dtype,
    "numpy._core.numeric._frombuffer": _from_buffer,
    "numpy._core.multiarray._reconstruct": _reconstructed,
    "numpy._core.multiarray.scalar": _called(
        lambda dtype, data: _array(data, dtype, (), "C")[()], np.dtype, bytes
    ),
    "numpy.random.bit_generator.__pyx_unpickle_SeedSequence": _seed_sequence,
    "numpy.random._pickle.__bit_generator_ctor": _bit_generator,
    "numpy.random._pickle.__generator_ctor": _generator,
}
_CLASSES_OF_NUMPY: Mapping[str, type] = {
    f"numpy.{kind.__name__}": kind
    for kind in (np.ndarray, np.float32, np.float64, np.int64, np.int32, np.int8, np.uint8)
} | {
    "numpy.bool_": np.bool_,
    "numpy.bool": np.bool_,
    "numpy.random._pcg64.PCG64": np.random.PCG64,
    "numpy.random.bit_generator.SeedSequence": np.random.SeedSequence,
}


# --- tensors --------------------------------------------------------------------------------------

# PyTorch's own reader trusts the sizes in a file: a few bytes can declare any number of elements.
# Here a tensor is built from the bytes of its storage, and uses each byte at most once.

_DTYPES: Mapping[str, th.dtype] = {
    f"torch.{kind}Storage": getattr(th, kind.lower())
    for kind in ("Bool", "Short", "Int", "Long", "Half", "BFloat16", "Float", "Double")
} | {
    "torch.ByteStorage": th.uint8,
    "torch.CharStorage": th.int8,
    "torch.ComplexFloatStorage": th.complex64,
    "torch.ComplexDoubleStorage": th.complex128,
}
_STORAGE = Name("torch.storage", "TypedStorage")


class _TensorReader(Reader):
    """Reads PyTorch's pickles of protocol 2, with storages in separate files."""

    prices = PRICES | {"GLOBAL": 104, "BINPUT": 104, "LONG_BINPUT": 104, "BINPERSID": 320}

    def __init__(self, file: io.BytesIO, budget: Budget) -> None:
        super().__init__(file, budget)
        self.storages: dict[tuple[Name, str], Made] = {}

    def persistent_load(self, pid: Any) -> Made:
        """Record a storage; a storage that the file names twice is one object."""
        _, kind, key, _, size, *_ = pid
        if not (isinstance(kind, Name) and isinstance(key, str) and isinstance(size, int)):
            raise UnsafeFileError("a storage that is not as PyTorch writes it")
        return self.storages.setdefault((kind, key), Made(_STORAGE, (kind, key, size)))


def load_tensors(content: bytes, budget: Budget | None = None) -> Any:
    """Load a ``.pth`` file: tensors in dictionaries and lists."""
    budget = budget or Budget(len(content))
    try:
        with opened_zip(content, budget) as archive:
            infos = archive.infolist()
            # PyTorch stores its records uncompressed; a deflated one is a zip bomb.
            if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
                raise UnsafeFileError("compressed tensors, which PyTorch does not write")
            members = {info.filename.partition("/")[2]: info for info in infos}
            if len(members) != len(infos):
                raise UnsafeFileError("a record twice")

            def record(name: str) -> bytes:
                # For the bytes, and for the tensors made from them.
                budget.charge(members[name].file_size)
                return read_member(archive, members[name])

            if "data.pkl" not in members:
                raise UnsafeFileError("no pickle of tensors")
            if "byteorder" in members and record("byteorder") != b"little":
                raise UnsafeFileError("numbers in another order of bytes")
            tree = _TensorReader(io.BytesIO(record("data.pkl")), budget).load()

            def storage(made: Made, build: Build) -> th.Tensor:
                return _flat(made, record(f"data/{made.args[1]}"))

            return Build({**_OF_TENSORS, _STORAGE.name: storage}, {}, budget).whole(tree)
    except UnsafeFileError as error:
        raise UnsafeFileError(f"holds tensors that cannot be read: {error}") from error


def _flat(made: Made, content: bytes) -> th.Tensor:
    """A storage as a one-dimensional tensor."""
    kind, _, size = made.args
    dtype = _DTYPES[kind.name]
    if made.state is not None:
        raise wrong(made)
    if size * dtype.itemsize != len(content):
        raise UnsafeFileError(f"a storage of {len(content):,} bytes for {shown(size)} elements")
    tensor = th.empty(size, dtype=dtype)
    tensor.view(th.uint8).numpy()[:] = np.frombuffer(content, np.uint8)
    return tensor


def _lone_storage(made: Made, build: Build) -> th.Tensor:
    """A storage in the legacy format, which PyTorch uses for tensors in other pickles."""
    (content,) = arguments(made, build, bytes)
    file = io.BytesIO(content)
    reader = _TensorReader(file, build.budget)
    # Three headers precede the storage; a list of keys and the size follow it.
    storage = [reader.load() for _ in range(5)][3]
    return _flat(storage, file.read()[8:])


def _tensor(made: Made, build: Build) -> th.Tensor:
    """A view of a storage in which no two elements overlap."""
    storage, offset, shape, strides, requires_grad = map(build, made.args[:5])
    is_tensor = isinstance(storage, th.Tensor) and len(shape) <= MAX_DIMENSIONS
    if made.state is not None or len(made.args) > 7 or not is_tensor:
        raise wrong(made)
    end = 1
    for stride, size in sorted(zip(strides, shape, strict=True)):
        if size > 1 and stride < end:
            raise UnsafeFileError("a tensor with overlapping elements")
        end += stride * (size - 1)
    if min((offset, *shape, *strides)) < 0 or (0 not in shape and offset + end > len(storage)):
        raise UnsafeFileError("a tensor that is larger than its storage")
    tensor: th.Tensor = storage.as_strided(shape, strides, offset)
    return tensor.requires_grad_(bool(requires_grad))


def _parameter(made: Made, build: Build) -> nn.Parameter:
    tensor, requires_grad, _ = build(made.args)
    return nn.Parameter(tensor, bool(requires_grad))


def _state_dict(made: Made, build: Build, has_versions: bool = True) -> OrderedDict[str, Any]:
    """An OrderedDict without PyTorch's metadata on module versions."""
    is_plain = all(isinstance(key, str) for key, _ in made.pairs)
    if made.args or made.items or not is_plain or (made.state is not None and not has_versions):
        raise wrong(made)
    return OrderedDict((key, build(value)) for key, value in made.pairs)


_OF_TENSORS: Mapping[str, Maker] = {
    "collections.OrderedDict": _state_dict,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": _parameter,
}


def check_values(files: Mapping[str, Any]) -> None:
    """Check that all values are tensors of finite numbers."""
    for name, content in files.items():
        for path, tensor in tensors_in(content):
            where = f"{name}: {shown(path)[1:-1]}"
            if tensor.is_complex():
                raise UnsafeFileError(f"{where} is not made of real numbers")
            if tensor.is_floating_point() and not bool(th.isfinite(tensor).all()):
                raise UnsafeFileError(f"{where} holds numbers that are not finite")


def tensors_in(content: Any, path: str = "") -> Iterator[tuple[str, th.Tensor]]:
    """The tensors in nested dictionaries and lists, each with its path."""
    if isinstance(content, th.Tensor):
        yield path, content
        return
    items: Any = content.items() if isinstance(content, dict) else ()
    if isinstance(content, list | tuple):
        items = enumerate(content)
    for key, value in items:
        yield from tensors_in(value, f"{path}.{key}" if path else str(key))


# --- Gymnasium's spaces ---------------------------------------------------------------------------

# No table or network has a larger input.
_MAX_SIZE = 10_000_000


def _space(made: Made, build: Build) -> spaces.Space[Any]:
    state = fields(made, build)
    kind = made.name.rpartition(".")[2]
    space: spaces.Space[Any]
    if kind == "Box":
        low, high = np.asarray(state["low"]), np.asarray(state["high"])
        space = spaces.Box(low, high, dtype=state["dtype"].type)
    elif kind in {"Tuple", "Dict"}:
        parts = state["spaces"]
        space = spaces.Tuple(tuple(parts)) if kind == "Tuple" else spaces.Dict(dict(parts))
    elif kind == "Discrete":
        n, start = int(state["n"]), int(state.get("start", 0))
        if not 0 < n <= _MAX_SIZE:
            raise wrong(made)
        dtype = {} if state.get("dtype") is None else {"dtype": state["dtype"].type}
        space = spaces.Discrete(n, start=start, **dtype)
    elif kind == "MultiDiscrete":
        counts = np.asarray(state["nvec"])
        if counts.sum() > _MAX_SIZE:
            raise wrong(made)
        first = state.get("start")
        space = spaces.MultiDiscrete(counts, dtype=state["dtype"].type, start=first)
    else:
        n = state["n"]
        if np.prod(n if isinstance(n, tuple) else int(n), dtype=float) > _MAX_SIZE:
            raise wrong(made)
        space = spaces.MultiBinary(n)
    generator = state.get("_np_random")
    if isinstance(generator, np.random.Generator):
        # Sampling continues from the saved state.
        space._np_random = generator
    return space


_OF_NUMBERS = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_SPACES: Mapping[str, Maker] = {
    f"{kind.__module__}.{kind.__name__}": _space
    for kind in (*_OF_NUMBERS, spaces.Tuple, spaces.Dict)
}


# --- schedules: the library's, rl_zoo3's, and ours from PyTorch classes ---------------------------

_NUMBER = (int, float)


def proportional(initial_value: float) -> Callable[[float], float]:
    """A linear schedule to 0 that a zip can contain without a class of this project."""
    return partial(operator.mul, initial_value)


def _partial(made: Made, build: Build) -> Callable[[float], float]:
    """Rebuild a saved result of `proportional`; refuse any other partial."""
    inner, args, *_ = made.state
    partials, number = Name("functools", "partial"), args[0]
    fits = made.args == (partials,) and inner == Name("_operator", "mul") and len(args) == 1
    if not fits or not isinstance(number, _NUMBER) or not math.isfinite(number):
        raise wrong(made)
    return proportional(number)


def _transform(make: Callable[..., Any], /, **kinds: tuple[type, ...]) -> Maker:
    def made_of(cache_size: int, _inverse: None, *values: Any) -> Any:
        if cache_size:
            raise ValueError("it keeps values")
        return make(*values)

    return _of_state(made_of, _cache_size=(int,), _inv=(type(None),), **kinds)


def _affine(loc: Any, scale: Any, event_dim: int) -> AffineTransform:
    if event_dim or not all(th.isfinite(th.as_tensor(value)).all() for value in (loc, scale)):
        raise ValueError("not finite")
    return AffineTransform(loc, scale)


def _composed(parts: list[Any]) -> ComposeTransform:
    """Rebuild a schedule from PyTorch transforms in sequence, such as exp(a + b x)."""
    kinds = ComposeTransform | AffineTransform | ExpTransform
    if not all(isinstance(part, kinds) for part in parts):
        raise TypeError("no transform")
    return ComposeTransform(parts)


def _code(made: Made, build: Build) -> None:
    """Refuse a function that was pickled with its code, as schedules were before version 2.6."""
    # The last text among the arguments of the code object is the function's name.
    code = made.args[0] if made.args else None
    texts = [one for one in getattr(code, "args", ()) if isinstance(one, str)]
    raise UnsafeFileError(", ".join(["holds a function with its code", *map(shown, texts[-1:])]))


_UTILS, _TRANSFORMS = "stable_baselines3.common.utils", "torch.distributions.transforms"
_VALUE_SCHEDULES = (ConstantSchedule, LinearSchedule, FloatSchedule, ComposeTransform, partial)
_SCHEDULES: Mapping[str, Maker] = {
    f"{_UTILS}.ConstantSchedule": _of_state(ConstantSchedule, val=_NUMBER),
    f"{_UTILS}.LinearSchedule": _of_state(
        LinearSchedule, start=_NUMBER, end=_NUMBER, end_fraction=_NUMBER
    ),
    f"{_UTILS}.FloatSchedule": _of_state(FloatSchedule, value_schedule=_VALUE_SCHEDULES),
    f"{_TRANSFORMS}.ExpTransform": _transform(ExpTransform),
    f"{_TRANSFORMS}.AffineTransform": _transform(
        _affine, loc=(*_NUMBER, th.Tensor), scale=(*_NUMBER, th.Tensor), _event_dim=(int,)
    ),
    f"{_TRANSFORMS}.ComposeTransform": _transform(_composed, parts=(list,)),
    "rl_zoo3.utils.SimpleLinearSchedule": _of_state(proportional, initial_value=_NUMBER),
    "functools.partial": _partial,
    "cloudpickle.cloudpickle._make_function": _code,
}


# --- other objects of Stable-Baselines3, PyTorch and Python's collections -------------------------

_COMMON = "stable_baselines3.common"
_OR_NONE = (*_NUMBERS, type(None))
_NOISES = NormalActionNoise | OrnsteinUhlenbeckActionNoise


def _deque(made: Made, build: Build) -> deque[Any]:
    # The arguments are its contents, always empty, and its maximum length.
    args = build(made.args)
    if made.state is not None or made.pairs or (args and args[0] not in ((), [])) or len(args) > 2:
        raise wrong(made)
    return deque(build(made.items), *args[1:])


def _filled(made: Any, **attributes: Any) -> Any:
    vars(made).update(attributes)
    return made


def _vectorized_noise(made: Made, build: Build) -> VectorizedActionNoise:
    state = fields(made, build)
    noises, base = state.get("_noises"), state.get("_base_noise")
    if not isinstance(noises, list) or not all(isinstance(one, _NOISES) for one in (base, *noises)):
        raise wrong(made)
    # The constructor would make as many copies as the file asks for.
    vectorized = VectorizedActionNoise(cast(Any, base), 1)
    vectorized.n_envs, vectorized.noises = len(noises), noises
    return vectorized


_OF_LIBRARIES: Mapping[str, Maker] = {
    "collections.OrderedDict": partial(_state_dict, has_versions=False),
    "collections.deque": _deque,
    f"{_COMMON}.type_aliases.TrainFreq": _called(TrainFreq, int, TrainFrequencyUnit),
    f"{_COMMON}.type_aliases.TrainFrequencyUnit": _called(TrainFrequencyUnit, str),
    f"{_COMMON}.running_mean_std.RunningMeanStd": _of_state(
        lambda mean, var, count: _filled(RunningMeanStd(), mean=mean, var=var, count=count),
        **dict.fromkeys(("mean", "var", "count"), _NUMBERS),
    ),
    f"{_COMMON}.noise.NormalActionNoise": _of_state(
        NormalActionNoise, _mu=_OR_NONE, _sigma=_OR_NONE, _dtype=(type,)
    ),
    f"{_COMMON}.noise.OrnsteinUhlenbeckActionNoise": _of_state(
        lambda *given: _filled(OrnsteinUhlenbeckActionNoise(*given[:-1]), noise_prev=given[-1]),
        **dict.fromkeys(("_mu", "_sigma", "_theta", "_dt", "initial_noise"), _OR_NONE),
        _dtype=(type,),
        noise_prev=_OR_NONE,
    ),
    f"{_COMMON}.noise.VectorizedActionNoise": _vectorized_noise,
    "stable_baselines3.her.goal_selection_strategy.GoalSelectionStrategy": _called(
        GoalSelectionStrategy, int
    ),
    # The caller chooses the device.
    "torch.device": lambda made, build: (
        arguments(made, build, *(str, int)[: max(len(made.args), 1)]) and th.device("cpu")
    ),
    "torch.storage._load_from_bytes": _lone_storage,
    "torch._utils._rebuild_tensor_v2": _tensor,
}


# --- classes, and the complete tables -------------------------------------------------------------


def by_name(classes: Iterable[type]) -> dict[str, type]:
    """Classes by their full names (module and qualified name)."""
    return {f"{cls.__module__}.{cls.__qualname__}": cls for cls in classes}


def _subclasses_in(module: object, base: type) -> Iterable[Any]:
    return (cls for cls in vars(module).values() if isinstance(cls, type) and issubclass(cls, base))


@cache
def _library_classes() -> Mapping[str, type]:
    """Buffers, feature extractors, activations and optimizers, by their full names."""
    modules: list[object] = [buffers]
    with contextlib.suppress(ImportError):
        names = (f"sb3_contrib.common.{kind}.buffers" for kind in ("maskable", "recurrent"))
        modules += [*map(importlib.import_module, names)]
    found = by_name(
        [
            *(cls for module in modules for cls in _subclasses_in(module, buffers.BaseBuffer)),
            *(HerReplayBuffer, RMSpropTFLike, nn.Identity),
            *_subclasses_in(torch_layers, torch_layers.BaseFeaturesExtractor),
            *_subclasses_in(activation, nn.Module),
            *_subclasses_in(optim, optim.Optimizer),
        ]
    )
    return {**_CLASSES_OF_NUMPY, **found}


def all_policy_classes() -> Mapping[str, type]:
    """The policies of all algorithms of Stable-Baselines3 and sb3-contrib, by their full names."""
    libraries: list[object] = [importlib.import_module("stable_baselines3")]
    with contextlib.suppress(ImportError):
        libraries.append(importlib.import_module("sb3_contrib"))
    algorithms = (one for library in libraries for one in _subclasses_in(library, BaseAlgorithm))
    return {name: cls for one in algorithms for name, cls in policy_classes(one).items()}


def policy_classes(algorithm: type[BaseAlgorithm]) -> Mapping[str, type]:
    """The policies that the algorithm knows, by their full names."""
    return by_name(algorithm.policy_aliases.values())


_MAKERS: Mapping[str, Maker] = {**_OF_NUMPY, **_SPACES, **_SCHEDULES, **_OF_LIBRARIES}


def read_pickle(
    pickled: bytes,
    classes: Mapping[str, type] | None = None,
    makers: Mapping[str, Maker] | None = None,
    budget: Budget | None = None,
) -> Any:
    """Build the value of a pickle without unpickling; arguments allow further objects."""
    budget = budget or Budget(len(pickled))
    build = Build({**_MAKERS, **(makers or {})}, {**_library_classes(), **(classes or {})}, budget)
    return build.whole(read_tree(pickled, budget))
