"""From a run folder, or a path, to an agent."""

from __future__ import annotations

import json
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents import ALGORITHMS, load_algorithm
from pipeline.errors import UserError, one_line
from pipeline.file_digests import RECORD, read_record
from pipeline.run_folder import Run
from pipeline.settings.constructor_arguments import algorithm_parameters

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

# What is done with files that are unpickled.
LIBRARY_ZIP = "loading a zip of a library agent"
STATISTICS = "reading statistics of VecNormalize"
REPLAY_BUFFER = "reading a replay buffer"


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


def check_origin(
    path: Path, log_folder: Path, given: Path | None = None, what: str = LIBRARY_ZIP
) -> None:
    """Make sure that a file that can run code lies where our own runs do.

    Args:
        path: the file.
        log_folder: the folder above all runs.
        given: what to call the file in a mistake; by default its path.
        what: what is about to be done with it: `LIBRARY_ZIP`, `STATISTICS` or `REPLAY_BUFFER`.

    Raises:
        UserError: if it lies elsewhere.
    """
    if not path.resolve().is_relative_to(log_folder.resolve()):
        raise UserError(
            f"{given or path} lies outside {log_folder}, and {what} can run code that is hidden in "
            "it: add --trust if you know where it comes from"
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
        with warnings.catch_warnings():
            # Said of the buffer that the library itself chose when the agent was made.
            warnings.filterwarnings("ignore", r"`n_steps=\d+` is ignored because a custom")
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


def load_to_play(algo: str, path: Path, env: VecEnv, device: str = "auto") -> BaseAlgorithm:
    """As `load_model`, for an agent that is not to learn any more.

    What only learning needs is left out: a replay buffer, and schedules, which zips of older
    versions of Python hold as functions that cannot be read. Observations may have other bounds.

    Raises:
        UserError: as `load_model`; and if the agent was trained on observations of another shape.
    """
    check_model_file(path)
    if hand_written_algorithm(path) is not None:
        return load_model(algo, path, env, device=device)
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.utils import ConstantSchedule

    saved, given = _saved_observation(path), _shown_space(vars(env.observation_space))
    if saved != given and saved is not None:
        raise UserError(
            f"{path} was trained on observations of {saved}, and the environment as it is made "
            f"here gives {given}: args.yml and config.yml beside the zip would say how it was made "
            "there, or --env-kwargs"
        )
    unused = ConstantSchedule(0.0)
    replaced: dict[str, Any] = {"learning_rate": 0.0, "lr_schedule": unused, "clip_range": unused}
    if saved is not None:
        replaced["observation_space"] = env.observation_space
    small = {"buffer_size": 1, "optimize_memory_usage": False}
    extra = small if issubclass(agent_class(algo), OffPolicyAlgorithm) else {}
    return load_model(algo, path, env, device=device, custom_objects=replaced, **extra)


def _plain_data(path: Path) -> dict[str, Any]:
    """The JSON that a zip of any agent holds; what is pickled in it stays text."""
    with zipfile.ZipFile(path) as archive:
        try:
            data = json.loads(archive.read("data"))
        except (ValueError, RecursionError) as error:
            raise UserError(f"{path} is no whole zip of an agent: {one_line(error)}") from error
    if not isinstance(data, dict):
        raise UserError(f"{path} is no whole zip of an agent: its data maps no names to values")
    return data


def _saved_observation(path: Path) -> str | None:
    """What a library's zip says of the space that its agent observes; None if nothing plain."""
    space = _plain_data(path).get("observation_space")
    return _shown_space(space) if isinstance(space, dict) else None


def _shown_space(attributes: Mapping[str, Any]) -> str | None:
    if "n" in attributes:
        return f"{attributes['n']} kinds"
    shape = attributes.get("_shape")
    return f"shape {tuple(shape)}" if shape else None


def load_replay_buffer(model: BaseAlgorithm, path: Path) -> None:
    """Give an agent the replay buffer in a file, where it is of a kind that has one.

    The file is unpickled, which can run code: load those that you trust.

    Raises:
        UserError: if it cannot be read, or was filled by other environments than the agent's.
    """
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    if not isinstance(model, OffPolicyAlgorithm):
        return
    wanted: Any = model.replay_buffer
    try:
        model.load_replay_buffer(path)
    except Exception as error:  # a pickle can fail in any way
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error
    buffer: Any = model.replay_buffer
    if buffer.n_envs != model.n_envs:
        raise UserError(
            f"{path} was filled by {buffer.n_envs} environments at once, and cannot be by "
            f"{model.n_envs}: give -params n_envs:{buffer.n_envs}"
        )
    for kind in ("observation_space", "action_space"):
        if getattr(buffer, kind) != getattr(model, kind):
            raise UserError(f"{path} was filled by environments of another {kind}")
    kinds = [(type(one).__name__, getattr(one, "n_steps", 1)) for one in (buffer, wanted)]
    if kinds[0] != kinds[1]:
        found, needed = (f"{name} with n_steps {n_steps}" for name, n_steps in kinds)
        raise UserError(f"{path} holds a {found}; these hyperparameters need a {needed}")


def run_of(path: Path) -> Run | None:
    """The run folder that a model file lies in, or None if it lies elsewhere."""
    folder = path.resolve().parent
    try:
        env_name = read_record(folder / RECORD).get("env_name")
    except (OSError, UserError):
        return None
    return Run(folder, env_name) if isinstance(env_name, str) else None


def hand_written_algorithm(path: Path) -> str | None:
    """The name of the hand-written agent that a zip says it holds, or None for the library's.

    Reads plain JSON and nothing else.

    Raises:
        UserError: if that is damaged.
    """
    class_name = _plain_data(path).get("algorithm")
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
