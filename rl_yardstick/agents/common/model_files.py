"""Reads and writes model files without pickles: tables as ``policy.pth``, the rest as JSON."""

from __future__ import annotations

import io
import json
import os
import re
import secrets
import warnings
import zipfile
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import stable_baselines3 as sb3
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import (
    ConstantSchedule,
    FloatSchedule,
    LinearSchedule,
    check_for_correct_spaces,
    get_system_info,
)
from stable_baselines3.common.vec_env import VecEnv

from rl_yardstick.agents.common.given_spaces import Translation, translation
from rl_yardstick.agents.common.schedules import ExponentialSchedule
from rl_yardstick.safe_files.files import (
    MAX_ARCHIVE_BYTES,
    UnsafeFileError,
    content_of,
    read_model,
    shown,
)
from rl_yardstick.safe_files.known_objects import check_values, load_tensors
from rl_yardstick.safe_files.models import charged_tensors, hides

# `encode` turns the attributes of an agent into JSON, `decode` reverses it. An object that JSON
# lacks is written as ``{"type": name, ...}`` and rebuilt by the fixed table `CODECS`, so reading a
# file can build nothing else.

TYPE = "type"

# Largest number of elements in a space: each table has a row or a column for each element.
_MAX_VALUES = 10_000_000

# Booleans and numbers of at most 64 bits, which JSON stores without loss.
_ARRAY_DTYPE = re.compile(r"[<>|][biuf][1248]")

# Exceptions that a constructor may raise for wrong values.
_DAMAGE = (TypeError, LookupError, AttributeError, AssertionError, ArithmeticError, RecursionError)


class UnknownTypeError(TypeError):
    """The file format cannot represent an object."""


@dataclass(frozen=True)
class Codec:
    """Encodes and decodes the objects of one class."""

    cls: type
    # For each field in the file, the function that reads its value from an object.
    fields: Mapping[str, Callable[[Any], Any]]
    build: Callable[..., Any]


def encode(value: Any) -> Any:
    """Turn ``value`` into JSON."""
    if type(value) in (dict, OrderedDict):  # a VecEnv's observations; Monitor's episode records
        return {TYPE: "dict", "pairs": [[*map(encode, pair)] for pair in value.items()]}
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list):
        return [*map(encode, value)]
    name = type(value).__name__
    codec = CODECS.get(name)
    if codec is None or type(value) is not codec.cls:
        raise UnknownTypeError(f"cannot be written as JSON: {type(value).__module__}.{name}")
    return {TYPE: name, **{key: encode(read(value)) for key, read in codec.fields.items()}}


def decode(data: Any) -> Any:
    """Rebuild the value that `encode` wrote."""
    if isinstance(data, list):
        return [decode(item) for item in data]
    if not isinstance(data, dict):
        return data
    name = data.get(TYPE)
    codec = CODECS.get(name) if isinstance(name, str) else None
    if codec is None:
        raise ValueError(f"unknown type {name!r} in an agent's file")
    if data.keys() != {TYPE, *codec.fields}:
        raise ValueError(f"damaged {name} in an agent's file: its fields are {', '.join(data)}")
    try:
        return codec.build(*(decode(data[key]) for key in codec.fields))
    except _DAMAGE as error:
        raise ValueError(f"damaged {name} in an agent's file: {error}") from error


def _attributes(*names: str) -> dict[str, Callable[[Any], Any]]:
    return {name: attrgetter(name) for name in names}


def _space(cls: type, make: Callable[..., Any], **fields: Callable[[Any], Any]) -> Codec:
    """Rebuild a space with its generator, so that sampling continues where it was."""

    def build(*values: Any) -> Any:
        *arguments, rng = values
        if not (rng is None or isinstance(rng, np.random.Generator)):
            raise TypeError(f"{rng!r} is no generator")
        space = make(*arguments)
        space._np_random = rng
        return space

    return Codec(cls, {**fields, "rng": attrgetter("_np_random")}, build)


def _generator_state(generator: np.random.Generator) -> Mapping[str, Any]:
    # `default_rng` makes this kind, and `_generator` rebuilds only this kind.
    if not isinstance(generator.bit_generator, np.random.PCG64):
        raise UnknownTypeError(f"cannot be written as JSON: {generator}")
    return generator.bit_generator.state


def _generator(state: dict[str, Any]) -> np.random.Generator:
    generator = np.random.default_rng()
    generator.bit_generator.state = state
    return generator


def _array_dtype(array: np.ndarray[Any, Any]) -> str:
    dtype: str = array.dtype.str
    if not _ARRAY_DTYPE.fullmatch(dtype):
        raise UnknownTypeError(f"cannot be written as JSON: an array of {array.dtype}")
    return dtype


def _array(dtype: str, shape: tuple[int, ...], values: list[Any]) -> np.ndarray[Any, Any]:
    if not _ARRAY_DTYPE.fullmatch(dtype):
        raise ValueError(f"unknown array type {dtype!r} in an agent's file")
    return np.array(values, dtype=np.dtype(dtype)).reshape(shape)


def _discrete(n: int, start: int) -> spaces.Discrete:
    if n > _MAX_VALUES:
        raise ValueError(f"a space of more than {_MAX_VALUES:,} values in an agent's file")
    return spaces.Discrete(n, start=start)


_system_info = cache(get_system_info)
_RANGE = _attributes("start", "end", "end_fraction")
_ARRAY: dict[str, Callable[[Any], Any]] = {
    "dtype": _array_dtype,
    "shape": attrgetter("shape"),
    "values": lambda array: array.ravel().tolist(),
}
_CODEC_LIST = [
    Codec(dict, {"pairs": lambda mapping: [*map(list, mapping.items())]}, dict),
    Codec(tuple, {"items": list}, tuple),
    Codec(deque, {"iterable": list, "maxlen": attrgetter("maxlen")}, deque),
    Codec(np.ndarray, _ARRAY, _array),
    Codec(th.Tensor, {"values": lambda tensor: tensor.detach().cpu().numpy()}, th.from_numpy),
    Codec(np.random.Generator, {"state": _generator_state}, _generator),
    Codec(ConstantSchedule, _attributes("val"), ConstantSchedule),
    Codec(LinearSchedule, _RANGE, LinearSchedule),
    Codec(ExponentialSchedule, _RANGE, ExponentialSchedule),
    Codec(FloatSchedule, _attributes("value_schedule"), FloatSchedule),
    _space(spaces.Discrete, _discrete, **_attributes("n", "start")),
    _space(
        spaces.MultiDiscrete,
        lambda nvec, start: spaces.MultiDiscrete(nvec, dtype=nvec.dtype.type, start=start),
        **_attributes("nvec", "start"),
    ),
    _space(spaces.MultiBinary, spaces.MultiBinary, **_attributes("n")),
    _space(
        spaces.Box,
        lambda low, high: spaces.Box(low, high, dtype=low.dtype.type),
        **_attributes("low", "high"),
    ),
    _space(spaces.Tuple, spaces.Tuple, spaces=lambda space: list(space.spaces)),
    # Pairs, because a Dict space sorts the keys of a plain mapping.
    _space(
        spaces.Dict,
        lambda pairs: spaces.Dict([(key, space) for key, space in pairs]),
        pairs=lambda space: [*map(list, space.spaces.items())],
    ),
]
CODECS = {codec.cls.__name__: codec for codec in _CODEC_LIST}


FORMAT_VERSION = 1
TABLES = "policy.pth"
MOST_ENVS = 100_000


class JsonAlgorithm(BaseAlgorithm):
    """An algorithm whose zip contains JSON instead of the library's pickles.

    Attributes:
        original_spaces: the spaces that the agent's own ones number; None if these are as given.
        translation: the bijections by which `predict` and `get_env` use the original spaces, as
            the environment does that was given; None if that has the agent's own spaces.
    """

    original_spaces: Any = None
    translation: Translation | None = None
    # `_setup_model` rebuilds these, or they belong to one process.
    _rebuilt: ClassVar[tuple[str, ...]] = (
        "lr_schedule",
        "policy_class",
        "start_time",
        "translation",
    )

    def use_spaces_of(self, given: Any) -> None:
        """Let `predict` use the spaces of an environment that was given; None: the original ones.

        Raises:
            ValueError: if the environment numbers the members of other spaces.
        """
        name = "original_spaces"
        if self.env is not None and self.env.has_attr(name):
            inside = self.env.get_attr(name)[0]
            if self.original_spaces not in (None, inside):
                raise ValueError(f"the agent learnt on {self.original_spaces}, not {inside}")
            self.original_spaces = inside
        has_own = hasattr(given, "has_wrapper_attr") and given.has_wrapper_attr(name)
        self.translation = None
        if self.original_spaces is not None and not (has_own or isinstance(given, VecEnv)):
            own = self.observation_space, self.action_space
            self.translation = translation(self.original_spaces, own)

    def save(
        self,
        path: str | Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Write the agent as a zip: JSON for its attributes, ``policy.pth`` for its tables.

        Arguments are the library's; ``.zip`` is appended to a path without a suffix.
        """
        left_out = {*self._excluded_save_params(), *self._rebuilt, *(exclude or ())}
        left_out -= set(include or ())
        data: dict[str, Any] = {"format": FORMAT_VERSION, "algorithm": type(self).__name__}
        for name, value in self.__dict__.items():
            if name in left_out:
                continue
            try:
                data[name] = encode(value)
            except UnknownTypeError:
                if not callable(value):
                    raise
                # Losing the learnt tables would be worse than losing the shape of a schedule.
                present = float(value(self._current_progress_remaining))
                warnings.warn(
                    f"{name} is a Python function, which a model file cannot hold: "
                    f"its present value {present} is saved instead",
                    stacklevel=2,
                )
                data[name] = present
        content = _zipped(data, self.get_parameters())
        file = open_path(path, "w", verbose=0, suffix="zip")
        file.write(content)
        if isinstance(path, str | Path):
            file.close()

    @classmethod
    def load(
        cls,
        path: str | Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "cpu",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """Build an agent from a zip that `save` wrote.

        Args:
            path: the zip; ``.zip`` is appended if no file of that name exists.
            env: environment for further training, or None to predict only.
            device: ignored, as tables live on the CPU.
            custom_objects: values that replace those of the same name in the file; the replaced
                ones are not read. Unknown names are ignored, as in the library.
            print_system_info: ignored.
            force_reset: begin a new episode at the next `learn`.
            kwargs: attributes to change.

        Raises:
            ValueError: if the zip holds another agent, is damaged, or does not fit ``env``; or if
                ``custom_objects`` is not a dictionary.
        """
        if not isinstance(path, io.BufferedIOBase):
            path = Path(path)
            path = path if path.exists() else path.with_name(f"{path.name}.zip")
        members, raw, budget = read_model(content_of(path, MAX_ARCHIVE_BYTES))
        data = {**cls._read_data(raw, path, custom_objects), **kwargs}
        given = env
        if env is not None:
            env = cls._wrap_env(env, data["verbose"])
            check_for_correct_spaces(env, data["observation_space"], data["action_space"])
            data["n_envs"] = env.num_envs
            if force_reset:
                data["_last_obs"] = None
        policy = next(iter(cls.policy_aliases))
        model = cls(policy=policy, env=env, _init_setup_model=False)  # type: ignore[call-arg]
        _check_names(model, data)
        for name in ("observation_space", "action_space"):
            if not isinstance(data.get(name), spaces.Space):
                raise UnsafeFileError(f"does not say its {name}")
        n_envs = data.get("n_envs")
        # The constructor allocates memory for the episodes of all environments.
        if not isinstance(n_envs, int) or not 1 <= n_envs <= MOST_ENVS:
            raise UnsafeFileError(
                f"is of an agent on {shown(n_envs)} environments, not on 1 to {MOST_ENVS}"
            )
        # With seed None, `_setup_model` does not reseed the loaded spaces.
        model.__dict__.update({**data, "seed": None})
        with charged_tensors(budget):
            model._setup_model()
        model.__dict__.update(data)
        model.use_spaces_of(given)
        if "seed" in kwargs:
            model.set_random_seed(kwargs["seed"])
        tables: Any = load_tensors(members[TABLES], budget) if TABLES in members else None
        _check_tables(tables, model.policy.state_dict())
        model.set_parameters({"policy": tables}, exact_match=True, device="cpu")
        return model

    @classmethod
    def _read_data(
        cls, raw: dict[str, Any], path: Any, replaced: dict[str, Any] | None
    ) -> dict[str, Any]:
        """The decoded attributes of a zip of this class, without the replaced ones."""
        if not (replaced is None or isinstance(replaced, dict)):
            raise ValueError("custom_objects must be a dictionary or None")
        known = replaced or {}
        named = "it" if isinstance(path, io.BufferedIOBase) else str(path)
        if raw.pop("algorithm", None) != cls.__name__:
            raise ValueError(f"{named} does not hold a {cls.__name__} agent")
        if raw.pop("format", None) != FORMAT_VERSION:
            raise ValueError(f"{named} is written in another version of the file format")
        return {
            name: known[name] if name in known else decode(value)
            for name, value in raw.items()
            # Older files may contain more.
            if name not in cls._rebuilt
        }


def _check_names(model: BaseAlgorithm, data: Iterable[str]) -> None:
    """Check that a file sets only attributes of a new agent, and hides no method."""
    declared = (vars(cls).get("__annotations__", {}) for cls in type(model).__mro__)
    known = {*vars(model)}.union(*declared)
    for name in data:
        if name not in known or hides(type(model), name):
            raise UnsafeFileError(f"sets {shown(name)}, which is no attribute of such an agent")


def _check_tables(found: Any, expected: Mapping[str, th.Tensor]) -> None:
    """Check that tables hold numbers, of the same dtype as in a new agent.

    PyTorch would convert one dtype into another. The policies check the shapes themselves.
    """
    if not isinstance(found, dict):
        raise UnsafeFileError(f"holds no {TABLES}")
    for key, table in found.items():
        like = expected.get(key)
        if not isinstance(table, th.Tensor) or (like is not None and table.dtype != like.dtype):
            raise UnsafeFileError(f"{TABLES}: {shown(key)} is not of the kind of such agents")
        # The score of an arm is infinite until its first pull.
        if like is not None and like.shape == table.shape and bool(th.isinf(like).any()):
            check_values({"policy": {key: table[~th.isinf(table)]}})
        else:
            check_values({"policy": {key: table}})


def _zipped(data: Mapping[str, Any], params: dict[str, Any]) -> bytes:
    """The zip with the members that the library writes, the JSON last.

    The JSON has one line for each attribute. With the library's deeper indentation, writing would
    take twice as long as all the rest.
    """
    members = {}
    for name, tables in {"pytorch_variables": {}, **params}.items():
        buffer = io.BytesIO()
        th.save(tables, buffer)
        members[f"{name}.pth"] = buffer.getvalue()
    members["_stable_baselines3_version"] = sb3.__version__.encode()
    members["system_info.txt"] = _system_info(print_info=False)[1].encode()
    lines = [f"{json.dumps(name)}: {json.dumps(value)}" for name, value in data.items()]
    members["data"] = ("{\n" + ",\n".join(lines) + "\n}").encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def key_of_user() -> bytes:
    """The key with which this user signs pickles, made on first use."""
    folder = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "yardstick"
    path = folder / "state.key"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        beside = folder / f"state.key.{os.getpid()}"
        beside.touch(mode=0o600)
        beside.write_bytes(secrets.token_bytes(32))
        with suppress(FileExistsError):
            os.link(beside, path)  # the first of several processes wins
        beside.unlink()
    return content_of(path, 1000)


class TablePolicy(BasePolicy):
    """A policy that stores what it has learnt in buffers on the CPU."""

    # The constructor's arguments that determine the buffers; attributes have the same names.
    sizes: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, **kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        sizes = {name: getattr(self, name) for name in self.sizes}
        return {**super()._get_constructor_parameters(), **sizes}
