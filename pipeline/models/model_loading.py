"""From a run folder, or a path, to an agent."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents import load_algorithm
from pipeline.errors import UserError, one_line
from pipeline.models.admitted_classes import own_classes
from pipeline.models.model_zips import (
    ModelFile,
    _is_hand_written,
    read_model,
    saved_observation,
    shown_space,
)
from pipeline.models.recorded_runs import read_recorded
from pipeline.run_folder import Run
from pipeline.settings.constructor_arguments import algorithm_parameters
from pipeline.user_modules import UserModule

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

# What a class of the user's may stand for in a zip.
_CLASS_KEYS = ("policy_class", "policy_kwargs", "replay_buffer_class", "rollout_buffer_class")


def agent_class(algo: str) -> type[BaseAlgorithm]:
    """Import the class of an agent.

    Raises:
        UserError: if it was registered wrongly, or its module cannot be imported.
    """
    try:
        return load_algorithm(algo)
    except (ValueError, ImportError) as error:
        raise UserError(one_line(error)) from error


def load_model(
    algo: str,
    model: ModelFile | Path,
    env: VecEnv | None = None,
    modules: Iterable[UserModule] = (),
    **kwargs: Any,
) -> BaseAlgorithm:
    """Load an agent from its zip, as data: nothing in it is run, whoever wrote it.

    Args:
        algo: name of the agent.
        model: the zip, or where it lies.
        env: environment to go on with, or None.
        modules: those that the user typed: the zip may name classes of theirs.
        kwargs: attributes to change.

    Raises:
        UserError: if the file is not a zip of such an agent, or does not fit ``env``.
    """
    file = _read(model)
    algorithm = agent_class(algo)
    try:
        with warnings.catch_warnings():
            # Said of the buffer that the library itself chose when the agent was made.
            warnings.filterwarnings("ignore", r"`n_steps=\d+` is ignored because a custom")
            agent = _loaded(algorithm, file, env, modules, kwargs)
        agent.__class__ = algorithm
        return agent
    except UserError:
        raise
    except Exception as error:  # a file of another agent can fail anywhere in the library
        raise UserError(
            f"{file.path} cannot be loaded as a {algo} agent: {one_line(error)}"
            f"{_way_out(algorithm, error)}"
        ) from error


def _loaded(
    algorithm: type[BaseAlgorithm],
    file: ModelFile,
    env: VecEnv | None,
    modules: Iterable[UserModule],
    kwargs: Mapping[str, Any],
) -> BaseAlgorithm:
    """An agent by its class's own `load`, where it has one, or else read as data."""
    from stable_baselines3.common.base_class import BaseAlgorithm

    from agents.common.model_files import JsonAlgorithm
    from safe_files import load_model

    if _is_load_of(JsonAlgorithm, algorithm):
        return algorithm.load(file.stream(), env=env, **kwargs)
    if not _is_load_of(BaseAlgorithm, algorithm):
        # Code of the user's, which may do with paths alone.
        return algorithm.load(file.path, env=env, **kwargs)
    return load_model(
        _loadable(algorithm),
        file.stream(),
        env,
        classes=own_classes(algorithm, modules),
        **kwargs,
    )


def _read(model: ModelFile | Path) -> ModelFile:
    return model if isinstance(model, ModelFile) else read_model(model)


def _is_load_of(owner: type, algorithm: type[BaseAlgorithm]) -> bool:
    """Whether the class loads as ``owner`` does."""
    return getattr(algorithm.load, "__func__", None) is vars(owner)["load"].__func__


def _way_out(algorithm: type[BaseAlgorithm], error: Exception) -> str:
    """What to do about an attribute that a zip may not hold."""
    key = getattr(error, "key", None)
    if key in _CLASS_KEYS:
        return "; a class of yours is admitted where you name its module: --gym-packages MODULE"
    if key in algorithm_parameters(algorithm):
        value = "3e-4" if key == "learning_rate" else "VALUE"
        return f"; train.py -i goes on with another: -params {key}:{value}"
    return ""


def _loadable(algorithm: type[BaseAlgorithm]) -> type[BaseAlgorithm]:
    """The class, or a subclass that does without the arguments that `load` hands a constructor."""
    parameters = algorithm_parameters(algorithm)
    lacking = {"policy", "device", "_init_setup_model"} - parameters.keys()
    if not lacking:
        return algorithm

    def without_them(self: Any, **kwargs: Any) -> None:
        initialise: Any = algorithm.__init__
        # What `_init_setup_model=False` is for: `load` sets up once it has restored the attributes.
        vars(self)["_setup_model"] = lambda: None
        initialise(self, **{name: value for name, value in kwargs.items() if name not in lacking})
        del vars(self)["_setup_model"]

    return type(algorithm.__name__, (algorithm,), {"__init__": without_them})


def load_to_play(
    algo: str,
    model: ModelFile | Path,
    env: VecEnv,
    device: str = "auto",
    modules: Iterable[UserModule] = (),
) -> BaseAlgorithm:
    """As `load_model`, for an agent that is not to learn any more.

    What only learning needs is left out: buffers, action noise, and schedules, which zips
    of older versions hold as functions. Observations may have other bounds.

    Raises:
        UserError: as `load_model`; and if the agent was trained on observations of another shape.
    """
    file = _read(model)
    if _is_hand_written(algo):
        return load_model(algo, file, env, device=device)
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.utils import ConstantSchedule

    saved, given = saved_observation(file), shown_space(vars(env.observation_space))
    if saved != given and saved is not None:
        raise UserError(
            f"{file.path} was trained on observations of {saved}, and the environment as it is "
            f"made here gives {given}: args.yml and config.yml beside the zip would say how it was "
            "made there, or --env-kwargs"
        )
    unused = ConstantSchedule(0.0)
    replaced: dict[str, Any] = {
        "learning_rate": 0.0,
        **dict.fromkeys(("lr_schedule", "clip_range", "clip_range_vf"), unused),
        "action_noise": None,
        "n_steps": 1,
    }
    if saved is not None:
        replaced["observation_space"] = env.observation_space
    small = {"buffer_size": 1, "optimize_memory_usage": False}
    extra = small if issubclass(agent_class(algo), OffPolicyAlgorithm) else {}
    return load_model(algo, file, env, modules, device=device, custom_objects=replaced, **extra)


def load_replay_buffer(model: BaseAlgorithm, path: Path, run: Run | None = None) -> None:
    """Give an agent the replay buffer in a file, where it is of a kind that has one.

    Args:
        model: the agent.
        path: the file.
        run: the run that it is of, whose record says what it was, or None.

    Raises:
        UserError: if it cannot be read, is not as the run left it, or was filled by other
            environments than the agent's.
    """
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    from agents.dqn import MaskedReplayBuffer
    from safe_files import load_replay_buffer as load_safely
    from safe_files.files import MAX_BUFFER_BYTES

    if not isinstance(model, OffPolicyAlgorithm):
        return
    wanted: Any = model.replay_buffer
    try:
        content = io.BytesIO(read_recorded(run, path, MAX_BUFFER_BYTES))
        load_safely(model, content, classes={MaskedReplayBuffer, type(wanted)})
    except (OSError, ValueError, AssertionError) as error:
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error
    buffer: Any = model.replay_buffer
    if buffer.n_envs != model.n_envs:
        raise UserError(
            f"{path} was filled by {buffer.n_envs} environments at once, and cannot be by "
            f"{model.n_envs}: give -params n_envs:{buffer.n_envs}"
        )
    kinds = [(type(one).__name__, getattr(one, "n_steps", 1)) for one in (buffer, wanted)]
    if kinds[0] != kinds[1]:
        found, needed = (f"{name} with n_steps {n_steps}" for name, n_steps in kinds)
        raise UserError(f"{path} holds a {found}; these hyperparameters need a {needed}")
