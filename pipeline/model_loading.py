"""From a run folder, or a path, to an agent."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents import ALGORITHMS, load_algorithm
from pipeline.errors import UserError, one_line
from pipeline.run_folder import Run
from pipeline.settings.constructor_arguments import algorithm_parameters

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv


def check_model_file(path: Path) -> None:
    """Make sure that ``path`` is a whole zip of an agent, without reading any agent from it.

    Raises:
        UserError: if it is missing, unreadable, damaged, or something else.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
            names = archive.namelist()
    except FileNotFoundError:
        raise UserError(f"no such model file: {path}") from None
    except (OSError, zipfile.BadZipFile) as error:
        raise UserError(f"{path} is no whole zip of an agent: {one_line(error)}") from error
    if damaged is not None:
        raise UserError(f"{path} is damaged: its part {damaged} does not match its checksum")
    if "data" not in names or not any(name.endswith(".pth") for name in names):
        raise UserError(f"{path} is no whole zip of an agent: it lacks parts that one has")


def check_origin(path: Path, log_folder: Path, given: Path | None = None) -> None:
    """Make sure that a zip of one of the library's agents lies where our own runs do.

    Args:
        path: the zip.
        log_folder: the folder above all runs.
        given: what to call the zip in a mistake; by default its path.

    Raises:
        UserError: if it lies elsewhere.
    """
    if not path.resolve().is_relative_to(log_folder.resolve()):
        raise UserError(
            f"{given or path} lies outside {log_folder}, and loading a zip of a library agent can "
            "run code that is hidden in it: add --trust if you know where it comes from"
        )


def agent_class(algo: str) -> type[BaseAlgorithm]:
    """Import the class of an agent.

    Raises:
        UserError: if it was registered wrongly, or its module cannot be imported.
    """
    try:
        return load_algorithm(algo)
    except (ValueError, ImportError) as error:
        raise UserError(one_line(error)) from error


def load_model(algo: str, path: Path, env: VecEnv | None = None, **kwargs: Any) -> BaseAlgorithm:
    """Load an agent from its zip.

    A zip of one of the library's agents is unpickled, which can run code: load those that you
    trust.

    Args:
        algo: name of the agent.
        path: the zip.
        env: environment to go on with, or None.
        kwargs: attributes to change.

    Raises:
        UserError: if the file is not a zip of such an agent, or does not fit ``env``.
    """
    check_model_file(path)
    algorithm = agent_class(algo)
    try:
        model = _loadable(algorithm).load(path, env=env, **kwargs)
        model.__class__ = algorithm
        return model
    except UserError:
        raise
    except Exception as error:  # a file of another agent can fail anywhere in the library
        raise UserError(f"{path} cannot be loaded as a {algo} agent: {one_line(error)}") from error


def _loadable(algorithm: type[BaseAlgorithm]) -> type[BaseAlgorithm]:
    """The class, or a subclass that does without the arguments that `load` hands a constructor."""
    from stable_baselines3.common.base_class import BaseAlgorithm

    parameters = algorithm_parameters(algorithm)
    is_own_load = (
        getattr(algorithm.load, "__func__", None) is not vars(BaseAlgorithm)["load"].__func__
    )
    lacking = {"policy", "device", "_init_setup_model"} - parameters.keys()
    if not lacking or is_own_load:
        return algorithm

    def without_them(self: Any, **kwargs: Any) -> None:
        initialise: Any = algorithm.__init__
        # What `_init_setup_model=False` is for: `load` sets up once it has restored the attributes.
        vars(self)["_setup_model"] = lambda: None
        initialise(self, **{name: value for name, value in kwargs.items() if name not in lacking})
        del vars(self)["_setup_model"]

    return type(algorithm.__name__, (algorithm,), {"__init__": without_them})


def run_of(path: Path) -> Run | None:
    """The run folder that a model file lies in, or None if it lies elsewhere."""
    folder = path.resolve().parent
    try:
        info = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        env_name = str(info["env_name"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return Run(folder, env_name)


def hand_written_algorithm(path: Path) -> str | None:
    """The name of the hand-written agent that a zip says it holds, or None for the library's.

    Reads plain JSON and nothing else.
    """
    with zipfile.ZipFile(path) as archive:
        class_name = json.loads(archive.read("data")).get("algorithm")
    for name, entry in ALGORITHMS.items():
        if (
            isinstance(class_name, str)
            and entry.entry_point.endswith(f":{class_name}")
            and _holds_no_pickle(name)
        ):
            return name
    return None


def _holds_no_pickle(algo: str) -> bool:
    """Whether zips of the agent are JSON; where its class is not to be had, they are not loaded."""
    from agents.common.model_files import JsonAlgorithm

    try:
        return issubclass(load_algorithm(algo), JsonAlgorithm)
    except ImportError:
        return True
