"""Model files without pickles: attributes as JSON, tables as ``policy.pth``."""

from __future__ import annotations

import io
import json
import pathlib
import sys
import warnings
import zipfile
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, ClassVar, Self

import stable_baselines3 as sb3
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces, get_system_info

from agents.common.serialization import UnknownTypeError, decode, encode
from safe_files.archives import MEMBERS, parse_settings, read_members
from safe_files.files import MAX_ARCHIVE_BYTES, Budget, UnsafeFileError, content_of, shown
from safe_files.known_objects import check_values, load_tensors
from safe_files.models import charged_tensors, hides

FORMAT_VERSION = 1
TENSORS = frozenset({"policy.pth"})
MOST_ENVS = 100_000


class JsonAlgorithm(BaseAlgorithm):
    """An algorithm whose zip holds JSON where the library's holds pickles."""

    # Rebuilt by `_setup_model`, or belonging to one process alone.
    _rebuilt: ClassVar[tuple[str, ...]] = ("lr_schedule", "policy_class", "start_time")

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Write the agent as a zip: JSON for its attributes, ``policy.pth`` for its tables.

        Args:
            path: where to; ``.zip`` is appended where a path has no suffix.
            exclude: attributes to leave out.
            include: attributes to write although they are left out by default.
        """
        left_out = {*self._excluded_save_params(), *self._rebuilt, *(exclude or ())}
        left_out -= set(include or ())
        data: dict[str, Any] = {"format": FORMAT_VERSION, "algorithm": type(self).__name__}
        for name, value in self.__dict__.items():
            if name not in left_out:
                data[name] = self._encode_attribute(name, value)
        content = _zipped(data, self.get_parameters())
        file = open_path(path, "w", verbose=0, suffix="zip")
        file.write(content)
        if isinstance(path, str | pathlib.Path):
            file.close()

    def _encode_attribute(self, name: str, value: Any) -> Any:
        try:
            return encode(value)
        except UnknownTypeError:
            if not callable(value):
                raise
            # Losing what was learnt would be worse than losing the shape of a schedule.
            present = float(value(self._current_progress_remaining))
            warnings.warn(
                f"{name} is a Python function, which a model file cannot hold: "
                f"its present value {present} is saved instead",
                stacklevel=3,
            )
            return present

    @classmethod
    def load(
        cls,
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "cpu",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """Build the agent anew from a zip that `save` wrote.

        Args:
            path: where the zip lies.
            env: environment to go on with, or None to predict only.
            device: ignored, as tables live on the CPU.
            custom_objects: values that replace those of the same name in the file, which are not
                read then; other names are passed over, as the library does.
            print_system_info: print the library versions that the file was written with.
            force_reset: begin a new episode at the next `learn`.
            kwargs: attributes to change.

        Raises:
            ValueError: if the zip is of another agent, or damaged, or does not fit ``env``; or if
                ``custom_objects`` is no dictionary.
        """
        content = _content(path)
        budget = Budget(len(content))
        members = read_members(content, MEMBERS, budget)
        if print_system_info:
            text = members.get("system_info.txt", b"").decode("ascii", "replace")
            # Nothing that a terminal obeys.
            sys.stdout.writelines(f"{shown(line)[1:-1]}\n" for line in text.splitlines())
        data = {**cls._read_data(members, budget, path, custom_objects), **kwargs}
        if env is not None:
            env = cls._wrap_env(env, data["verbose"])
            check_for_correct_spaces(env, data["observation_space"], data["action_space"])
            data["n_envs"] = env.num_envs
            if force_reset:
                data["_last_obs"] = None
        policy = next(iter(cls.policy_aliases))
        model = cls(policy=policy, env=env, _init_setup_model=False)  # type: ignore[call-arg]
        _check_names(model, data)
        _check_spaces(data)
        _check_n_envs(data.get("n_envs"))
        # Without a seed, setting up leaves alone what was saved with its state.
        model.__dict__.update({**data, "seed": None})
        with charged_tensors(budget):
            model._setup_model()
        model.__dict__.update(data)
        if "seed" in kwargs:
            model.set_random_seed(kwargs["seed"])
        parameters = {
            name.removesuffix(".pth"): load_tensors(members[name], budget)
            for name in sorted(TENSORS & set(members))
        }
        _check_tables(parameters, model.get_parameters())
        model.set_parameters(parameters, exact_match=True, device="cpu")
        return model

    @classmethod
    def _read_data(
        cls,
        members: Mapping[str, bytes],
        budget: Budget,
        path: Any,
        replaced: dict[str, Any] | None,
    ) -> dict[str, Any]:
        """The decoded attributes of a zip of this very class, but for those that are replaced."""
        if not (replaced is None or isinstance(replaced, dict)):
            raise ValueError("custom_objects must be a dictionary or None")
        known = replaced or {}
        raw = parse_settings(members, budget)
        if raw.pop("algorithm", None) != cls.__name__:
            raise ValueError(f"{_named(path)} does not hold a {cls.__name__} agent")
        if raw.pop("format", None) != FORMAT_VERSION:
            raise ValueError(f"{_named(path)} is written in another version of the file format")
        return {
            name: known[name] if name in known else decode(value)
            for name, value in raw.items()
            # Files that are older may hold more.
            if name not in cls._rebuilt
        }


def _named(path: str | pathlib.Path | io.BufferedIOBase) -> str:
    return "it" if isinstance(path, io.BufferedIOBase) else str(path)


def _content(path: str | pathlib.Path | io.BufferedIOBase) -> bytes:
    """All of a file, read once; ``.zip`` is appended where there is none of that name."""
    if not isinstance(path, io.BufferedIOBase):
        path = pathlib.Path(path)
        if not path.exists():
            path = path.with_name(f"{path.name}.zip")
    return content_of(path, MAX_ARCHIVE_BYTES)


def _check_names(model: BaseAlgorithm, data: Iterable[str]) -> None:
    """Make sure that a file sets only what a new agent has, and hides none of its methods."""
    known = {*vars(model), *(name for cls in type(model).__mro__ for name in _declared(cls))}
    for name in data:
        if name not in known or hides(type(model), name):
            raise UnsafeFileError(f"sets {shown(name)}, which is no attribute of such an agent")


def _check_spaces(data: Mapping[str, Any]) -> None:
    for name in ("observation_space", "action_space"):
        if not isinstance(data.get(name), spaces.Space):
            raise UnsafeFileError(f"does not say its {name}")


def _check_n_envs(n: Any) -> None:
    """An agent makes room for the episodes of all its environments as soon as it is made."""
    if not isinstance(n, int) or not 1 <= n <= MOST_ENVS:
        raise UnsafeFileError(f"is of an agent on {shown(n)} environments, not on 1 to {MOST_ENVS}")


def _declared(cls: type) -> Iterable[str]:
    found: Mapping[str, Any] = vars(cls).get("__annotations__", {})
    return found


def _check_tables(found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Make sure that tables are of numbers, and of the kind that a new agent's have.

    PyTorch would turn one kind into another; of shapes, the policies make sure themselves.
    """
    for name, tables in expected.items():
        if not isinstance(found.get(name), dict):
            raise UnsafeFileError(f"holds no {name}.pth")
        for key, table in found[name].items():
            like = tables.get(key)
            if not isinstance(table, th.Tensor) or (like is not None and table.dtype != like.dtype):
                raise UnsafeFileError(f"{name}.pth: {shown(key)} is not of the kind of such agents")
            # Scores of arms that were never pulled are infinite from the beginning.
            is_like = like is not None and like.shape == table.shape
            may_be_infinite = is_like and bool(th.isinf(like).any())
            check_values({name: {key: table[~th.isinf(table)] if may_be_infinite else table}})


def _zipped(data: Mapping[str, Any], params: dict[str, Any]) -> bytes:
    """The members that the library writes, with the JSON at the end.

    A line for each attribute: indented further, as the library does it, writing takes Python twice
    as long as all the rest.
    """
    members = {"pytorch_variables.pth": _saved({})}
    members |= {f"{name}.pth": _saved(tables) for name, tables in params.items()}
    members["_stable_baselines3_version"] = sb3.__version__.encode()
    members["system_info.txt"] = _system_info().encode()
    lines = [f"{json.dumps(name)}: {json.dumps(value)}" for name, value in data.items()]
    members["data"] = ("{\n" + ",\n".join(lines) + "\n}").encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def _saved(tables: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    th.save(tables, buffer)
    return buffer.getvalue()


@cache
def _system_info() -> str:
    return get_system_info(print_info=False)[1]
