"""Model files without pickles: attributes as JSON, tables as ``policy.pth``."""

from __future__ import annotations

import io
import json
import pathlib
import warnings
import zipfile
from collections.abc import Iterable
from typing import Any, ClassVar, Self, cast

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, open_path, save_to_zip_file
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces

from agents.common.serialization import UnknownTypeError, decode, encode

FORMAT_VERSION = 1


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
        save_to_zip_file(path, data=data, params=self.get_parameters(), pytorch_variables={})

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
            print_system_info: print this system's and the file's library versions.
            force_reset: begin a new episode at the next `learn`.
            kwargs: attributes to change.

        Raises:
            ValueError: if the zip is of another agent, or damaged, or does not fit ``env``; or if
                ``custom_objects`` is no dictionary.
        """
        _, parameters, _ = load_from_zip_file(
            path, load_data=False, device="cpu", print_system_info=print_system_info
        )
        data = {**cls._read_data(path, custom_objects), **kwargs}
        if env is not None:
            env = cls._wrap_env(env, data["verbose"])
            check_for_correct_spaces(env, data["observation_space"], data["action_space"])
            data["n_envs"] = env.num_envs
            if force_reset:
                data["_last_obs"] = None
        policy = next(iter(cls.policy_aliases))
        model = cls(policy=policy, env=env, _init_setup_model=False)  # type: ignore[call-arg]
        # Without a seed, setting up leaves alone what was saved with its state.
        model.__dict__.update({**data, "seed": None})
        model._setup_model()
        model.__dict__.update(data)
        if "seed" in kwargs:
            model.set_random_seed(kwargs["seed"])
        model.set_parameters(cast(dict[str, Any], parameters), exact_match=True, device="cpu")
        return model

    @classmethod
    def _read_data(
        cls, path: str | pathlib.Path | io.BufferedIOBase, replaced: dict[str, Any] | None
    ) -> dict[str, Any]:
        """The decoded attributes of a zip of this very class, but for those that are replaced."""
        if not (replaced is None or isinstance(replaced, dict)):
            raise ValueError("custom_objects must be a dictionary or None")
        known = replaced or {}
        with (
            open_path(path, "r", suffix="zip") as file,
            zipfile.ZipFile(file) as archive,
        ):
            raw = json.loads(archive.read("data"))
        if raw.pop("algorithm", None) != cls.__name__:
            raise ValueError(f"{path} does not hold a {cls.__name__} agent")
        if raw.pop("format", None) != FORMAT_VERSION:
            raise ValueError(f"{path} is written in another version of the file format")
        return {
            name: known[name] if name in known else decode(value) for name, value in raw.items()
        }
