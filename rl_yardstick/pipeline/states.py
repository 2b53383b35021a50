"""Pickles the state of a running training, and restores it into a newly built training.

- Objects of the process (log files, threads, windows, the run) are not pickled. The state records
  their place in the training; restoring takes the object at that place of the new training.
- Attributes of agent, environments, buffers and callbacks are filled into the newly built ones,
  because running functions refer to these objects.
- The memory of arrays and tensors is stored beside the pickle, without a copy; objects that
  shared memory share it again.

A pickle can run any code: `pipeline.state_files` loads only pickles that this user has signed.
"""

from __future__ import annotations

import copyreg
import functools
import importlib
import io
import os
import pickle
import random
import sys
import threading
import weakref
from bisect import bisect_right, insort
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import PurePath
from types import CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any, ClassVar, NamedTuple

import cloudpickle
import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv

# Running functions refer to these objects, so they must stay the same objects.
FILLED_IN = (BaseAlgorithm, BasePolicy, BaseBuffer, BaseCallback, ActionNoise, VecEnv, gym.Env)

# Attributes that are not saved, by class name. A class of this project lists its own in
# `excluded_from_states`.
_EXCLUDED = {
    "stable_baselines3.common.callbacks.BaseCallback": ("locals", "globals"),
    "stable_baselines3.common.vec_env.base_vec_env.VecEnvWrapper": ("class_attributes",),
}
# Compiled functions, windows and their clocks, progress bars, row writers: rebuilt when needed.
_MADE_ANEW = ("numba", "llvmlite", "pygame", "_csv", "moviepy", "tensorboard", "rich", "tqdm")
# Exceptions from `_MADE_ANEW` with data, which are pickled.
_HOLDING_DATA = ("numba.typed", "numba.experimental", "_csv.reader")
_GAME_DATA = ("Rect", "FRect", "Vector2", "Vector3", "Color", "Mask", "PixelArray", "BufferProxy")
# Handles of things outside this process, which cannot be copied.
_OUTSIDE = (
    "subprocess.Popen",
    "multiprocessing.process.BaseProcess",
    "multiprocessing.connection._ConnectionBase",
    "tempfile.TemporaryDirectory",
)
# Global generators of libraries: restored as the same objects, not as copies.
_SHARED: dict[int, tuple[Any, str]] = {
    id(random._inst): (random, "_inst"),
    id(np.random.mtrand._rand): (np.random.mtrand, "_rand"),
    id(th.default_generator): (th, "default_generator"),
}
_LOCKS: dict[type, Callable[[], Any]] = {
    type(threading.Lock()): threading.Lock,
    type(threading.RLock()): threading.RLock,
}
_FEW = 100
_POINTER = 8  # bytes


class NotKeepableError(Exception):
    """An object in a training cannot be pickled; the message says where it is, and why."""


class NotFittingError(Exception):
    """A state does not fit the newly built training."""


class Place(NamedTuple):
    """The place of an object: the steps to it, as `_children` names them, and its class name."""

    steps: Sequence[str]
    class_name: str


@dataclass(frozen=True)
class Pickled:
    """A pickle with the data that it refers to."""

    pickled: bytes | memoryview
    places: Sequence[Place]  # of objects from the newly built training
    memories: Sequence[NDArray[np.uint8] | th.Tensor]
    has_code: bool = False  # functions, which another version of Python cannot read
    lost: Sequence[str] = ()  # relevant objects that are not saved, with their places


# --- from objects to a pickle --------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Memory:
    """A memory block that arrays and tensors share."""

    begin: int
    content: NDArray[np.uint8]
    is_tensor: bool

    def reaches(self, begin: int, end: int) -> bool:
        return self.begin <= begin and end <= self.begin + len(self.content)


def pickled(roots: dict[str, Any], kept: tuple[type, ...] = ()) -> Pickled:
    """Pickle named objects; instances of the classes ``kept`` belong to the process.

    The memories are not copied: write them before the training continues. An object that cannot be
    pickled raises `NotKeepableError`, which names its place.
    """
    stream = io.BytesIO()
    pickler = _Pickler(stream, roots, kept)
    pickler.write()
    memories = [
        th.from_numpy(memory.content) if memory.is_tensor else memory.content
        for memory in pickler.memories
    ]
    return Pickled(stream.getbuffer(), pickler.places, memories, pickler.has_code, pickler.lost)


class _Pickler(cloudpickle.Pickler):  # type: ignore[misc]
    """Pickles a training; `reducer_override` decides how each type of object is pickled."""

    def __init__(self, file: io.BytesIO, roots: dict[str, Any], kept: tuple[type, ...]) -> None:
        super().__init__(file, protocol=5, buffer_callback=lambda _: None)
        self.roots = roots
        self.kept = kept
        self.places: list[Place] = []
        self.memories: list[Memory] = []
        self.lost: list[str] = []
        self.has_code = False
        self._known_memories: dict[int, Memory] = {}
        self._begins: list[int] = []
        self._steps = _steps_to(roots, everything=False)
        self._all_steps: dict[int, tuple[str, ...]] | None = None
        self._last: Any = None

    def write(self) -> None:
        """Pickle the roots."""
        try:
            self.dump(self.roots)
        except (NotKeepableError, MemoryError):
            raise
        except Exception as error:  # reading objects may raise anything
            deep = isinstance(error, RecursionError) or isinstance(error.__cause__, RecursionError)
            if deep or "recursion" in str(error):
                raise NotKeepableError("objects are nested too deeply") from None
            raise self._not_keepable(self._last, error) from error

    def reducer_override(self, obj: Any) -> Any:  # noqa: PLR0912  # a table
        """Decide how an object is pickled; never called for containers, numbers and texts."""
        self._last = obj
        kind: Any = type(obj)
        if kind is Memory:
            self.memories.append(obj)
            return _memory, (pickle.PickleBuffer(obj.content),)
        if isinstance(obj, np.ndarray) and kind.__reduce__ is np.ndarray.__reduce__:
            return self._array(obj)
        if isinstance(obj, th.Tensor) and kind in (th.Tensor, th.nn.Parameter):
            return self._tensor(obj)
        if id(obj) in _SHARED:
            return getattr, _SHARED[id(obj)]
        if isinstance(obj, type | FunctionType | ModuleType):
            return self._code(obj)
        if isinstance(obj, functools._lru_cache_wrapper):
            return self._cached(obj)
        if isinstance(obj, self.kept) or self._is_of_process(obj):
            return _existing, (self._place_of(obj),)
        if any(f"{base.__module__}.{base.__qualname__}" in _OUTSIDE for base in kind.__mro__):
            raise self._not_keepable(obj)
        if kind in _LOCKS:
            return _LOCKS[kind], ()
        if isinstance(obj, PurePath):
            return kind, (str(obj),)
        if kind is weakref.ref:
            return _weak_reference, (obj(), obj.__callback__)
        if kind is CellType:
            return _empty_cell, ()  # its function fills it
        if kind is th.Generator:
            return _torch_generator, (obj.get_state(),)
        if kind is memoryview:
            raise self._not_keepable(obj)
        # `__getstate__` of a class with plain attributes is not used: it may omit data that a model
        # file does not need, or rebuild the object, as `EzPickle` does.
        has_own_reduce = (
            kind.__reduce_ex__ is not object.__reduce_ex__
            or kind.__reduce__ is not object.__reduce__
            or kind in self.dispatch_table
        )
        return NotImplemented if has_own_reduce or _hides_state(kind) else self._attributes(obj)

    def _is_of_process(self, obj: Any) -> bool:
        """Whether an object belongs to the process, and comes from the newly built training."""
        kind = type(obj)
        if isinstance(obj, io.IOBase):
            if kind in (io.BytesIO, io.StringIO):
                return False
            if obj.closed or obj is sys.stdin or not obj.readable():
                return True
            raise self._not_keepable(obj)
        if isinstance(obj, threading.Thread | weakref.ref) and kind is not weakref.ref:
            return True
        return _is_made_anew(kind)

    def _attributes(self, obj: Any) -> Any:
        kind: Any = type(obj)
        excluded = _excluded(kind)
        held = {name: value for name, value in _attributes_of(obj) if name not in excluded}
        if _is_filled_in(kind) and id(obj) in self._steps:
            return _filled_in, (self._place_of(obj), kind), held, None, None, _fill
        return _blank, (kind,), held, None, None, _fill

    def _code(self, obj: Any) -> Any:
        """Pickle classes and functions by name; those without an importable name by value."""
        name = _name_of(obj)
        if not isinstance(obj, ModuleType) and name and _find(name) is obj:
            # cloudpickle would copy classes and functions of `__main__`.
            return (_find, (name,)) if obj.__module__ == "__main__" else NotImplemented
        reduced = super().reducer_override(obj)
        if reduced is NotImplemented or isinstance(obj, ModuleType):
            return reduced
        self.has_code = True
        module = sys.modules.get(obj.__module__ or "")
        if not isinstance(obj, FunctionType) or vars(module or obj) is not obj.__globals__:
            return reduced
        cells = obj.__closure__ or ()
        contents = [(cell, cell.cell_contents) for cell in cells if not _is_empty(cell)]
        named = {name: getattr(obj, name) for name in _FUNCTION_ATTRIBUTES}
        state = (vars(obj), named, contents)
        arguments = (obj.__code__, obj.__module__, obj.__name__, cells)
        return _function, arguments, state, None, None, _fill_function

    def _cached(self, obj: Any) -> Any:
        """Pickle a function with `lru_cache` by name, or else by its place."""
        if obj.cache_info().currsize:
            self.lost.append(f"the cache of {self._where(obj)}")
        name = _name_of(obj)
        return (_find, (name,)) if _find(name) is obj else (_existing, (self._place_of(obj),))

    def _array(self, array: NDArray[Any]) -> Any:
        if type(array) is not np.ndarray and not isinstance(array, np.memmap):
            plain, added = array.view(np.ndarray), dict(getattr(array, "__dict__", {}))
            return np.ndarray.view, (plain, type(array)), added, None, None, _fill
        if array.dtype.hasobject:
            return NotImplemented
        array = array.view(np.ndarray) if isinstance(array, np.memmap) else array
        owner: Any = array
        while isinstance(owner.base, np.ndarray):
            owner = owner.base
        if isinstance(owner.base, th.Tensor) and owner.base.device.type == "cpu":
            memory = self._memory_of_storage(owner.base)
        else:
            begin, end = np.lib.array_utils.byte_bounds(owner)
            memory = self._memory(begin, end - begin, False, owner)
        address = array.__array_interface__["data"][0]
        if not memory.reaches(*np.lib.array_utils.byte_bounds(array)):  # of a wrapped pointer
            begin, end = np.lib.array_utils.byte_bounds(array)
            memory = self._memory(begin, end - begin, False, array)
        place = address - memory.begin, array.shape, array.strides, array.flags.writeable
        return _array, (memory, array.dtype, *place)

    def _tensor(self, tensor: th.Tensor) -> Any:
        if tensor.layout is not th.strided or tensor.is_quantized:
            raise self._not_keepable(tensor, "only dense tensors can be copied")
        plain = tensor.detach().resolve_conj().resolve_neg().cpu()
        memory = self._memory_of_storage(plain)
        begin = plain.data_ptr() - memory.begin if plain.numel() else 0
        is_parameter = isinstance(tensor, th.nn.Parameter)
        is_trained = tensor.requires_grad and tensor.is_leaf
        place = plain.dtype, begin, tuple(plain.shape), plain.stride(), tensor.device
        return _tensor, (memory, *place, is_parameter, is_trained)

    def _memory_of_storage(self, tensor: th.Tensor) -> Memory:
        storage = tensor.untyped_storage()
        return self._memory(storage.data_ptr(), storage.nbytes(), True, (tensor, storage))

    def _memory(self, begin: int, n_bytes: int, is_tensor: bool, owner: Any) -> Memory:
        place = bisect_right(self._begins, begin)
        known = self._known_memories[self._begins[place - 1]] if place else None
        if n_bytes and known is not None and known.reaches(begin, begin + n_bytes):
            return known
        memory = Memory(begin, _bytes_at(begin, n_bytes, owner), is_tensor)
        if n_bytes:
            self._known_memories[begin] = memory
            insort(self._begins, begin)
        return memory

    def _place_of(self, obj: Any) -> int:
        """The number of an object's place."""
        place = Place(self._steps_of(obj), _name_of(type(obj)))
        if not place.steps and not _is_made_anew(type(obj)):
            raise self._not_keepable(obj)
        self.places.append(place)
        return len(self.places) - 1

    def _steps_of(self, obj: Any) -> tuple[str, ...]:
        if id(obj) in self._steps:
            return self._steps[id(obj)]
        if self._all_steps is None:
            self._all_steps = _steps_to(self.roots, everything=True)
        return self._all_steps.get(id(obj), ())

    def _where(self, obj: Any) -> str:
        return "".join(self._steps_of(obj)) or "the training"

    def _not_keepable(self, obj: Any, reason: object = "") -> NotKeepableError:
        kind = f"{type(obj).__module__}.{type(obj).__qualname__}"
        if isinstance(reason, TypeError | NotImplementedError | pickle.PicklingError) or not reason:
            reason = f"what a {kind} holds cannot be copied"
        elif isinstance(reason, Exception):
            reason = f"{type(reason).__name__}: {reason}"
        return NotKeepableError(f"{self._where(obj)}: {reason}")


def _steps_to(roots: Mapping[str, Any], everything: bool) -> dict[int, tuple[str, ...]]:
    """The steps from the roots to objects, by id: to all, or only through filled-in objects."""
    found: dict[int, tuple[str, ...]] = {}
    pending: deque[tuple[tuple[str, ...], Any, bool]] = deque(
        ((name,), value, True) for name, value in roots.items()
    )
    while pending:
        steps, value, is_near = pending.popleft()
        if id(value) in found:
            continue
        found[id(value)] = steps
        kind: Any = type(value)
        opens = _is_filled_in(kind)
        few = kind is MethodType or (kind in (list, tuple, dict) and len(value) <= _FEW)
        if opens or everything or (few and is_near):
            with suppress(Exception):  # the pickler will report it
                pending.extend(((*steps, step), held, opens) for step, held in _children(value))
    return found


def _children(value: Any) -> Iterator[tuple[str, Any]]:  # noqa: PLR0912  # a table
    """The values inside a value, each with the step to it in Python syntax."""
    if isinstance(value, dict):
        for key, held in value.items():
            if isinstance(key, str | int) and not isinstance(held, _SIMPLE):
                yield f"[{key!r}]", held
    elif isinstance(value, list | tuple | deque):
        for i, held in enumerate(value):
            if not isinstance(held, _SIMPLE):
                yield f"[{i}]", held
    elif isinstance(value, MethodType):
        yield ".__self__", value.__self__
    elif isinstance(value, FunctionType):
        for i, cell in enumerate(value.__closure__ or ()):
            if not _is_empty(cell):
                yield f"()[{i}]", cell.cell_contents
    elif not isinstance(value, type | ModuleType | np.ndarray | th.Tensor):
        for name, held in _attributes_of(value):
            if not isinstance(held, _SIMPLE):
                yield f".{name}", held


_SIMPLE = (bool, int, float, str, bytes, type(None))
_FUNCTION_ATTRIBUTES = (
    "__qualname__",
    "__annotations__",
    "__defaults__",
    "__kwdefaults__",
    "__doc__",
)


def _attributes_of(obj: Any) -> Iterator[tuple[str, Any]]:
    kind: Any = type(obj)
    for name in _slots(kind):
        if hasattr(obj, name):
            yield name, getattr(obj, name)
    yield from list(getattr(obj, "__dict__", {}).items())


@functools.cache
def _slots(kind: Any) -> tuple[str, ...]:
    """The attribute names of the slots of a class and its base classes."""
    # `object.__reduce_ex__` uses the same list, which the type checker does not know.
    slot_names: Any = getattr(copyreg, "_slotnames")  # noqa: B009
    return tuple(slot_names(kind))


def _hides_state(kind: type) -> bool:
    """Whether objects of a class have state besides attributes, as classes in C do."""
    declares_slots = any("__slots__" in vars(base) for base in kind.__mro__)
    if kind is not object and not kind.__dictoffset__ and not declares_slots:
        return True  # every class in Python has a dictionary or slots
    # Object header, attribute dictionary, weak references, and a pointer for each slot.
    plain = object.__basicsize__ + 2 * _POINTER + _POINTER * len(_slots(kind))
    return kind.__itemsize__ > 0 or kind.__basicsize__ > plain


def _is_made_anew(kind: type) -> bool:
    if f"{kind.__module__}.{kind.__name__}".startswith(_HOLDING_DATA):
        return False
    top = kind.__module__.partition(".")[0]
    if top == "pygame" and (kind.__name__ in _GAME_DATA or not _hides_state(kind)):
        return False
    return top in _MADE_ANEW


@functools.cache
def _is_filled_in(kind: Any) -> bool:
    return issubclass(kind, FILLED_IN)


@functools.cache
def _excluded(kind: Any) -> frozenset[str]:
    names: set[str] = set()
    for base in kind.__mro__:
        names.update(_EXCLUDED.get(f"{base.__module__}.{base.__qualname__}", ()))
        names.update(vars(base).get("excluded_from_states", ()))
    return frozenset(names)


def _name_of(value: Any) -> str:
    """Module and qualified name of a class or function; empty if it has none."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    return f"{module}:{name}" if isinstance(module, str) and isinstance(name, str) else ""


def _find(name: str) -> Any:
    """The class or function of a `_name_of`, in an imported module; else None."""
    module, _, path = name.partition(":")
    found: Any = sys.modules.get(module)
    for part in path.split("."):
        found = getattr(found, part, None)
    return found if _name_of(found) == name else None


def _is_empty(cell: CellType) -> bool:
    try:
        cell.cell_contents  # noqa: B018  # reading is the only test
    except ValueError:
        return True
    return False


def _bytes_at(begin: int, n_bytes: int, owner: Any) -> NDArray[np.uint8]:
    """The memory at an address as an array, which keeps the memory's owner alive."""
    if not n_bytes:
        return np.zeros(0, np.uint8)
    interface = {"data": (begin, False), "shape": (n_bytes,), "typestr": "|u1", "version": 3}
    return np.asarray(type("Bytes", (), {"__array_interface__": interface, "owner": owner})())


# --- from a pickle to objects --------------------------------------------------------------------


def unpickled(
    state: Pickled, roots: dict[str, Any], moved: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Unpickle a state of this user into the newly built objects of the same names.

    Texts that begin with a folder in ``moved`` are changed. Returns the saved objects by name;
    objects of `FILLED_IN` are those of ``roots``. `NotFittingError` names an object of the process
    that is missing in the new training.
    """
    renamed = {before: now for before, now in (moved or {}).items() if before != now}
    existing = [_follow(roots, place) for place in state.places]
    reader = _MovingUnpickler if renamed else _Unpickler
    unpickler = reader(io.BytesIO(state.pickled), buffers=state.memories)
    unpickler.existing, unpickler.places, unpickler.moved = existing, state.places, renamed
    restored: dict[str, Any] = unpickler.load()
    return restored


def _follow(roots: Mapping[str, Any], place: Place) -> Any:
    """The object at a place; None if there is none."""
    first, *steps = place.steps or ("",)
    found: Any = roots.get(first)
    for step in steps:
        found = next((held for name, held in _children(found) if name == step), None)
    return found


class _Existing:
    """Looks up the newly built training's objects at the places of a state."""

    existing: list[Any]
    places: Sequence[Place]
    moved: dict[str, str]

    def find_class(self, module: str, name: str) -> Any:
        if module == __name__ and name in ("_existing", "_filled_in"):
            return getattr(self, name)
        return super().find_class(module, name)  # type: ignore[misc]

    def _existing(self, number: int) -> Any:
        found, place = self.existing[number], self.places[number]
        wanted, above = place.class_name, type(found).__mro__
        if wanted not in map(_name_of, above) and not wanted.startswith(_MADE_ANEW):
            where = "".join(place.steps)
            raise NotFittingError(f"{wanted.replace(':', '.')} is missing in {where}")
        return found

    def _filled_in(self, number: int, kind: type) -> Any:
        found = self.existing[number]
        if isinstance(found, FILLED_IN) and type(found) is not kind:
            where = "".join(self.places[number].steps)
            raise NotFittingError(f"{kind.__qualname__} is missing in {where}")
        return found if type(found) is kind else _blank(kind)


class _Unpickler(_Existing, pickle.Unpickler):
    pass


class _MovingUnpickler(_Existing, pickle._Unpickler):
    """Changes texts that begin with a moved folder; slower, because it is written in Python."""

    dispatch: ClassVar = dict(pickle._Unpickler.dispatch)

    def _load_text(self, load: Callable[[Any], None]) -> None:
        load(self)
        stack: list[Any] = vars(self)["stack"]
        for before, now in self.moved.items():
            if stack[-1] == before or stack[-1].startswith(before + os.sep):
                stack[-1] = now + stack[-1][len(before) :]
                break

    for _code in (pickle.SHORT_BINUNICODE, pickle.BINUNICODE, pickle.BINUNICODE8):
        dispatch[_code[0]] = functools.partial(
            lambda self, load: self._load_text(load), load=dispatch[_code[0]]
        )


def _existing(number: int) -> Any:
    raise AssertionError("stands for the method of the same name")


def _filled_in(number: int, kind: type) -> Any:
    raise AssertionError("stands for the method of the same name")


def _blank(kind: type) -> Any:
    return object.__new__(kind)


def _fill(obj: Any, attributes: dict[str, Any]) -> None:
    """Replace the attributes of an object, except those that are not saved."""
    kind: Any = type(obj)
    slots, inside = _slots(kind), getattr(obj, "__dict__", {})
    for name in inside.keys() - attributes.keys() - _excluded(kind):
        del inside[name]
    for name, value in attributes.items():
        if name in slots:
            object.__setattr__(obj, name, value)
        else:
            inside[name] = value


def _memory(content: Any) -> Any:
    return content


def _array(
    memory: Any,
    dtype: np.dtype[Any],
    offset: int,
    shape: tuple[int, ...],
    strides: tuple[int, ...],
    writeable: bool,
) -> NDArray[Any]:
    content = memory.numpy() if isinstance(memory, th.Tensor) else memory
    array: NDArray[Any] = np.ndarray(shape, dtype, content, offset, strides)
    array.flags.writeable = writeable
    return array


def _tensor(
    memory: Any,
    dtype: th.dtype,
    offset: int,
    shape: tuple[int, ...],
    strides: tuple[int, ...],
    device: th.device,
    is_parameter: bool,
    is_trained: bool,
) -> th.Tensor:
    content = memory if isinstance(memory, th.Tensor) else th.from_numpy(memory)
    tensor = th.empty(0, dtype=dtype)
    tensor.set_(content.untyped_storage(), offset // dtype.itemsize, shape, strides)
    tensor = tensor.to(device)
    if is_parameter:
        return th.nn.Parameter(tensor, is_trained)
    return tensor.requires_grad_(is_trained)


def _torch_generator(state: th.Tensor) -> th.Generator:
    generator = th.Generator()
    generator.set_state(state)
    return generator


def _weak_reference(referent: Any, callback: Any) -> Any:
    # A dead reference becomes a reference to a new object that is deleted at once.
    return weakref.ref(type("Gone", (), {})() if referent is None else referent, callback)


def _empty_cell() -> CellType:
    return CellType()


def _function(code: CodeType, module: str, name: str, cells: tuple[CellType, ...]) -> FunctionType:
    """Rebuild a nested function with the global names of its module."""
    return FunctionType(code, vars(importlib.import_module(module)), name, None, cells)


def _fill_function(function: FunctionType, state: tuple[Any, Any, Iterable[Any]]) -> None:
    attributes, named, contents = state
    vars(function).update(attributes)
    for name, value in named.items():
        setattr(function, name, value)
    for cell, content in contents:
        cell.cell_contents = content
