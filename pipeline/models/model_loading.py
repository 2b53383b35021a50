"""From a run folder, or a path, to an agent."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents import load_algorithm
from pipeline.errors import UserError, one_line
from pipeline.models.admitted_classes import own_classes, own_makers
from pipeline.models.model_zips import (
    _is_hand_written,
    check_model_file,
    saved_observation,
    shown_space,
)
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
    path: Path,
    env: VecEnv | None = None,
    modules: Iterable[UserModule] = (),
    **kwargs: Any,
) -> BaseAlgorithm:
    """Load an agent from its zip, as data: nothing in it is run, whoever wrote it.

    Args:
        algo: name of the agent.
        path: the zip.
        env: environment to go on with, or None.
        modules: those that the user typed: the zip may name classes of theirs.
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
            model = _loaded(algorithm, path, env, modules, kwargs)
        model.__class__ = algorithm
        return model
    except UserError:
        raise
    except Exception as error:  # a file of another agent can fail anywhere in the library
        raise UserError(
            f"{path} cannot be loaded as a {algo} agent: {one_line(error)}"
            f"{_way_out(algorithm, error)}"
        ) from error


def _loaded(
    algorithm: type[BaseAlgorithm],
    path: Path,
    env: VecEnv | None,
    modules: Iterable[UserModule],
    kwargs: Mapping[str, Any],
) -> BaseAlgorithm:
    """An agent by its class's own `load`, where it has one, or else read as data."""
    from safe_files import load_model

    if _has_own_load(algorithm):
        # Of ours, which reads JSON and tensors, or code of the user's.
        return algorithm.load(path, env=env, **kwargs)
    return load_model(
        _loadable(algorithm),
        path,
        env,
        classes=own_classes(algorithm, modules),
        makers=own_makers(),
        **kwargs,
    )


def _has_own_load(algorithm: type[BaseAlgorithm]) -> bool:
    from stable_baselines3.common.base_class import BaseAlgorithm

    return getattr(algorithm.load, "__func__", None) is not vars(BaseAlgorithm)["load"].__func__


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
    path: Path,
    env: VecEnv,
    device: str = "auto",
    modules: Iterable[UserModule] = (),
) -> BaseAlgorithm:
    """As `load_model`, for an agent that is not to learn any more.

    What only learning needs is left out: a replay buffer, action noise, and schedules, which zips
    of older versions hold as functions. Observations may have other bounds.

    Raises:
        UserError: as `load_model`; and if the agent was trained on observations of another shape.
    """
    check_model_file(path)
    if _is_hand_written(algo):
        return load_model(algo, path, env, device=device)
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.utils import ConstantSchedule

    saved, given = saved_observation(path), shown_space(vars(env.observation_space))
    if saved != given and saved is not None:
        raise UserError(
            f"{path} was trained on observations of {saved}, and the environment as it is made "
            f"here gives {given}: args.yml and config.yml beside the zip would say how it was made "
            "there, or --env-kwargs"
        )
    unused = ConstantSchedule(0.0)
    replaced: dict[str, Any] = {
        "learning_rate": 0.0,
        **dict.fromkeys(("lr_schedule", "clip_range", "clip_range_vf"), unused),
        "action_noise": None,
    }
    if saved is not None:
        replaced["observation_space"] = env.observation_space
    small = {"buffer_size": 1, "optimize_memory_usage": False}
    extra = small if issubclass(agent_class(algo), OffPolicyAlgorithm) else {}
    return load_model(algo, path, env, modules, device=device, custom_objects=replaced, **extra)


def load_replay_buffer(model: BaseAlgorithm, path: Path) -> None:
    """Give an agent the replay buffer in a file, where it is of a kind that has one.

    Raises:
        UserError: if it cannot be read, or was filled by other environments than the agent's.
    """
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    from agents.dqn import MaskedReplayBuffer
    from safe_files import load_replay_buffer as load_safely

    if not isinstance(model, OffPolicyAlgorithm):
        return
    wanted: Any = model.replay_buffer
    try:
        load_safely(model, path, classes={MaskedReplayBuffer, type(wanted)})
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
