"""All that may stand in files of models, and what makes it from what a file says."""

from __future__ import annotations

import contextlib
import math
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from functools import cache
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
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch import nn, optim
from torch.nn.modules import activation

from safe_files import library_schedules, tensors
from safe_files.limits import MAX_DIMENSIONS, Budget
from safe_files.pickle_trees import Made, read_tree
from safe_files.rebuilding import Admitted, Build, Maker, arguments, fields, rebuild, wrong
from safe_files.refusals import UnsafeFileError
from safe_files.tensors import lone_storage

# --- NumPy's types, arrays, numbers and generators ------------------------------------------------

# Booleans, whole numbers, floats; no texts, records, dates, and no Python objects.
_TYPES = frozenset(["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"])
_OBJECT = "O8"
_ORDERS = "<>=|"
_MAX_POOL = 64


def _dtype(made: Made, build: Build) -> np.dtype[Any]:
    code = made.args[0] if made.args else None
    state = made.state
    order = state[1] if isinstance(state, tuple) and len(state) > 1 else "="
    if code == _OBJECT:
        return np.dtype(object)
    if code not in _TYPES or not isinstance(order, str) or order not in _ORDERS:
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
    count = math.prod(shape)
    if dtype.hasobject:
        return _object_array(data, count, shape, order)
    if not isinstance(data, bytes) or len(data) != count * dtype.itemsize:
        raise UnsafeFileError("holds an array whose size does not match its data")
    # A copy, since what is read from bytes cannot be written to.
    return np.frombuffer(data, dtype).reshape(shape, order=order).copy(order=order)


def _object_array(data: Any, count: int, shape: tuple[int, ...], order: Any) -> NDArray[Any]:
    """An array of dictionaries and plain values, such as the infos of a replay buffer."""
    if not isinstance(data, list) or len(data) != count:
        raise UnsafeFileError("holds an array whose size does not match its data")
    flat = np.empty(count, dtype=object)
    for index, value in enumerate(data):
        flat[index] = value
    return flat.reshape(shape, order=order)


def _from_buffer(made: Made, build: Build) -> NDArray[Any]:
    kinds = (bytes, np.dtype, (tuple, int), str, tuple)
    data, dtype, shape, order, *axes = arguments(made, build, *kinds[: max(len(made.args), 4)])
    if not axes:
        return _array(data, dtype, shape, order)
    # Since NumPy 2.3, of an array whose axes lie in the memory in another order.
    return _array(data, dtype, shape, "C").transpose(axes[0])


def _reconstructed(made: Made, build: Build) -> NDArray[Any]:
    state = build(made.state)
    if not (isinstance(state, tuple) and len(state) == 5) or made.items or made.pairs:
        raise wrong(made)
    _, shape, dtype, is_fortran, data = state
    return _array(data, dtype, shape, "F" if is_fortran else "C")


def _scalar(made: Made, build: Build) -> Any:
    dtype, data = arguments(made, build, np.dtype, bytes)
    return _array(data, dtype, (), "C")[()]


def _seed_sequence(made: Made, build: Build) -> np.random.SeedSequence:
    """What a generator was seeded with; its class and a checksum are the arguments."""
    state = build(made.state)
    if not (isinstance(state, tuple) and len(state) == 5) or made.items or made.pairs:
        raise wrong(made)
    entropy, n_children, _, pool_size, spawn_key = state
    if not (isinstance(pool_size, int) and pool_size <= _MAX_POOL):
        raise wrong(made)
    return np.random.SeedSequence(
        entropy, spawn_key=spawn_key, pool_size=pool_size, n_children_spawned=n_children
    )


def _bit_generator(made: Made, build: Build) -> np.random.PCG64:
    state = None if made.state is None else build(made.state)
    seeds = None
    if isinstance(state, tuple) and len(state) == 2:
        state, seeds = state
    if not (seeds is None or isinstance(seeds, np.random.SeedSequence)):
        raise wrong(made)
    generator = np.random.PCG64(seeds)
    if state is not None:
        generator.state = cast(Any, state)
    return generator


def _generator(made: Made, build: Build) -> np.random.Generator:
    # Older files name the maker of the inner generator as a second argument.
    inner = build(made.args[0]) if made.args else None
    if not isinstance(inner, np.random.PCG64):
        raise wrong(made)
    return np.random.Generator(inner)


_OF_NUMPY: Mapping[str, Maker] = {
    "numpy.dtype": _dtype,
    "numpy._core.numeric._frombuffer": _from_buffer,
    "numpy._core.multiarray._reconstruct": _reconstructed,
    "numpy._core.multiarray.scalar": _scalar,
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


# --- Gymnasium's spaces ---------------------------------------------------------------------------

# Beyond this no table or network has an input.
_MAX_SIZE = 10_000_000

_Space = spaces.Space[Any]


def _box(state: Mapping[str, Any]) -> _Space:
    low, high = np.asarray(state["low"]), np.asarray(state["high"])
    return spaces.Box(low, high, dtype=state["dtype"].type)


def _discrete(state: Mapping[str, Any]) -> _Space:
    n, start = int(state["n"]), int(state.get("start", 0))
    if not 0 < n <= _MAX_SIZE:
        raise ValueError("too many values")
    dtype = state.get("dtype")
    return spaces.Discrete(n, start=start, **({} if dtype is None else {"dtype": dtype.type}))


def _multi_discrete(state: Mapping[str, Any]) -> _Space:
    counts = np.asarray(state["nvec"])
    if counts.sum() > _MAX_SIZE:
        raise ValueError("too many values")
    start = state.get("start")
    return spaces.MultiDiscrete(counts, dtype=state["dtype"].type, start=start)


def _multi_binary(state: Mapping[str, Any]) -> _Space:
    n = state["n"]
    shape = n if isinstance(n, tuple) else (int(n),)
    if np.prod(shape, dtype=float) > _MAX_SIZE:
        raise ValueError("too many values")
    return spaces.MultiBinary(n)


def _tuple(state: Mapping[str, Any]) -> _Space:
    return spaces.Tuple(tuple(state["spaces"]))


def _dict(state: Mapping[str, Any]) -> _Space:
    return spaces.Dict(dict(state["spaces"]))


def _maker(make: Callable[[Mapping[str, Any]], _Space]) -> Maker:
    def maker(made: Made, build: Build) -> _Space:
        state = fields(made, build)
        space = make(state)
        generator = state.get("_np_random")
        if isinstance(generator, np.random.Generator):
            # Whoever goes on with the model draws on from where it was.
            space._np_random = generator
        return space

    return maker


_SPACES: Mapping[str, Maker] = {
    "gymnasium.spaces.box.Box": _maker(_box),
    "gymnasium.spaces.discrete.Discrete": _maker(_discrete),
    "gymnasium.spaces.multi_discrete.MultiDiscrete": _maker(_multi_discrete),
    "gymnasium.spaces.multi_binary.MultiBinary": _maker(_multi_binary),
    "gymnasium.spaces.tuple.Tuple": _maker(_tuple),
    "gymnasium.spaces.dict.Dict": _maker(_dict),
}


# --- objects of Stable-Baselines3, PyTorch and Python's collections -------------------------------

_COMMON = "stable_baselines3.common"
_NUMBERS = (int, float, np.number, np.ndarray)


def _ordered_dict(made: Made, build: Build) -> OrderedDict[Any, Any]:
    if made.args or made.state is not None or made.items:
        raise wrong(made)
    return OrderedDict((build(key), build(value)) for key, value in _string_keys(made))


def _string_keys(made: Made) -> list[tuple[Any, Any]]:
    if not all(isinstance(key, str) for key, _ in made.pairs):
        raise wrong(made)
    return made.pairs


def _deque(made: Made, build: Build) -> deque[Any]:
    # The arguments are what it holds, always nothing, and its greatest length.
    args = tuple(build(arg) for arg in made.args)
    if made.state is not None or made.pairs or (args and args[0] not in ((), [])) or len(args) > 2:
        raise wrong(made)
    return deque((build(item) for item in made.items), *args[1:])


def _train_freq(made: Made, build: Build) -> TrainFreq:
    return TrainFreq(*arguments(made, build, int, TrainFrequencyUnit))


def _train_frequency_unit(made: Made, build: Build) -> TrainFrequencyUnit:
    return TrainFrequencyUnit(*arguments(made, build, str))


def _goal_selection(made: Made, build: Build) -> GoalSelectionStrategy:
    return GoalSelectionStrategy(*arguments(made, build, int))


def _running_mean_std(made: Made, build: Build) -> RunningMeanStd:
    state = fields(made, build)
    if set(state) != {"mean", "var", "count"}:
        raise wrong(made)
    statistics = RunningMeanStd()
    for name, value in state.items():
        if not isinstance(value, _NUMBERS) or not np.isfinite(value).all():
            raise wrong(made)
        setattr(statistics, name, value)
    return statistics


def _normal_noise(made: Made, build: Build) -> NormalActionNoise:
    state = _noise_state(made, build)
    return NormalActionNoise(state["_mu"], state["_sigma"], state["_dtype"])


def _ornstein_uhlenbeck_noise(made: Made, build: Build) -> OrnsteinUhlenbeckActionNoise:
    state = _noise_state(made, build)
    names = ("_mu", "_sigma", "_theta", "_dt", "initial_noise", "_dtype")
    noise = OrnsteinUhlenbeckActionNoise(*(state[name] for name in names))
    noise.noise_prev = state["noise_prev"]
    return noise


def _noise_state(made: Made, build: Build) -> Mapping[str, Any]:
    state = fields(made, build)
    kinds = {name: (type,) if name == "_dtype" else (*_NUMBERS, type(None)) for name in state}
    if not all(isinstance(value, kinds[name]) for name, value in state.items()):
        raise wrong(made)
    return state


def _vectorized_noise(made: Made, build: Build) -> VectorizedActionNoise:
    state = fields(made, build)
    noises = state.get("_noises")
    kinds = NormalActionNoise | OrnsteinUhlenbeckActionNoise
    fits = isinstance(noises, list) and all(isinstance(noise, kinds) for noise in noises)
    if not fits or not isinstance(state.get("_base_noise"), kinds):
        raise wrong(made)
    assert noises is not None
    vectorized = VectorizedActionNoise(state["_base_noise"], len(noises))
    vectorized.noises = noises
    return vectorized


def _device(made: Made, build: Build) -> th.device:
    # Whatever the file says: what is read lands where its reader wants it.
    arguments(made, build, *((str,) if len(made.args) == 1 else (str, int)))
    return th.device("cpu")


def _storage(made: Made, build: Build) -> th.Tensor:
    (data,) = arguments(made, build, bytes)
    return lone_storage(data, Budget(len(data)))


_OF_LIBRARIES: Mapping[str, Maker] = {
    "collections.OrderedDict": _ordered_dict,
    "collections.deque": _deque,
    f"{_COMMON}.type_aliases.TrainFreq": _train_freq,
    f"{_COMMON}.type_aliases.TrainFrequencyUnit": _train_frequency_unit,
    f"{_COMMON}.running_mean_std.RunningMeanStd": _running_mean_std,
    f"{_COMMON}.noise.NormalActionNoise": _normal_noise,
    f"{_COMMON}.noise.OrnsteinUhlenbeckActionNoise": _ornstein_uhlenbeck_noise,
    f"{_COMMON}.noise.VectorizedActionNoise": _vectorized_noise,
    "stable_baselines3.her.goal_selection_strategy.GoalSelectionStrategy": _goal_selection,
    "torch.device": _device,
    "torch.storage._load_from_bytes": _storage,
    "torch._utils._rebuild_tensor_v2": tensors.MAKERS["torch._utils._rebuild_tensor_v2"],
}


# --- classes, none of which is called with anything but a model's settings ------------------------


def full_name(cls: type) -> str:
    """The class's module and qualified name."""
    return f"{cls.__module__}.{cls.__qualname__}"


def _by_name(classes: Iterable[type]) -> dict[str, type]:
    return {full_name(cls): cls for cls in classes}


def _subclasses_in(module: object, base: type) -> Iterable[Any]:
    return (cls for cls in vars(module).values() if isinstance(cls, type) and issubclass(cls, base))


def library_classes() -> Mapping[str, type]:
    """Buffers, feature extractors, activations and optimizers, by their full names."""
    return {
        **_by_name(_subclasses_in(buffers, buffers.BaseBuffer)),
        **_by_name([HerReplayBuffer, RMSpropTFLike, nn.Identity]),
        **_by_name(_subclasses_in(torch_layers, torch_layers.BaseFeaturesExtractor)),
        **_by_name(_subclasses_in(activation, nn.Module)),
        **_by_name(_subclasses_in(optim, optim.Optimizer)),
        **_contrib_classes(),
    }


def _contrib_classes() -> Mapping[str, type]:
    try:
        from sb3_contrib.common.maskable import buffers as maskable
        from sb3_contrib.common.recurrent import buffers as recurrent
    except ImportError:
        return {}
    found = (*_subclasses_in(maskable, buffers.BaseBuffer),)
    return _by_name((*found, *_subclasses_in(recurrent, buffers.BaseBuffer)))


def all_policy_classes() -> Mapping[str, type]:
    """The policies of all algorithms of Stable-Baselines3 and sb3-contrib, by their full names."""
    import stable_baselines3 as sb3

    libraries: list[object] = [sb3]
    with contextlib.suppress(ImportError):
        import sb3_contrib

        libraries.append(sb3_contrib)
    algorithms = (one for library in libraries for one in _subclasses_in(library, BaseAlgorithm))
    return {name: cls for one in algorithms for name, cls in policy_classes(one).items()}


def policy_classes(algorithm: type[BaseAlgorithm]) -> Mapping[str, type]:
    """The policies that the algorithm knows, by their full names."""
    return _by_name(algorithm.policy_aliases.values())


# --- the table ------------------------------------------------------------------------------------


@cache
def admitted() -> Admitted:
    """What may stand in any of the files."""
    makers = {
        **_OF_NUMPY,
        **_SPACES,
        **_OF_LIBRARIES,
        **library_schedules.MAKERS,
    }
    return Admitted(makers, {**_CLASSES_OF_NUMPY, **library_classes()})


def read_pickle(
    pickled: bytes,
    classes: Mapping[str, type] | None = None,
    makers: Mapping[str, Maker] | None = None,
    budget: Budget | None = None,
) -> Any:
    """What a pickle stands for, made without unpickling.

    Args:
        pickled: the pickle.
        classes: further classes that it may name, by their full names.
        makers: what makes further objects in it, likewise.
        budget: pays for it; None for that of a file that is this pickle.

    Raises:
        UnsafeFileError: if it is damaged, or holds what may not stand in it.
    """
    budget = budget or Budget(len(pickled))
    usual = admitted()
    own = makers or {}
    here = Admitted({**usual.makers, **own}, {**usual.classes, **(classes or {})}, own.keys())
    return rebuild(read_tree(pickled, budget), here, budget)
