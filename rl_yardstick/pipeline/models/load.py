"""Loads and saves agents and their statistics; runs no code from a file.

The settings in a zip are plain JSON, and are read without making an agent. A zip may also name
classes of the libraries and this project, and the user's networks, optimizers and buffers from
modules on the command line or from the agent's own module.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import sys
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.files import replacing
from rl_yardstick.pipeline.models.find import read_recorded
from rl_yardstick.pipeline.runs import Run
from rl_yardstick.pipeline.settings.values import algorithm_parameters
from rl_yardstick.pipeline.train_spec import TrainSpec
from rl_yardstick.pipeline.user_modules import UserModule

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.running_mean_std import RunningMeanStd
    from stable_baselines3.common.vec_env import VecEnv


# Folders of `agents` whose agents never pickle; known without importing them.
_JSON_FAMILIES = {"tabular", "linear", "bandits", "mabwiser"}


@dataclass(frozen=True)
class ModelFile:
    """A zip in memory: the same bytes are checked against the digest, inspected and loaded.

    Replacing the file on disk meanwhile has no effect.
    """

    path: Path  # the path of the zip
    content: bytes = field(repr=False)  # the whole file
    # its JSON; pickles in it stay text
    data: Mapping[str, Any] = field(repr=False)

    @property
    def digest(self) -> str:
        """The SHA-256 of the content, in the format of ``run.json``."""
        return hashlib.sha256(self.content).hexdigest()

    def stream(self) -> io.BytesIO:
        """The content as a stream."""
        return io.BytesIO(self.content)


def read_model(path: Path, run: Run | None = None) -> ModelFile:
    """Read an agent's zip and check that it is complete, without making an agent."""
    from rl_yardstick.safe_files.archives import first_look
    from rl_yardstick.safe_files.files import MAX_ARCHIVE_BYTES

    try:
        content = read_recorded(run, path, MAX_ARCHIVE_BYTES)
        return ModelFile(path, content, first_look(content))
    except FileNotFoundError:
        raise UserError(f"no such model file: {path}") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is no whole zip of an agent: {one_line(error)}") from error


def _shown_space(attributes: Any) -> str | None:
    """A space in words, by its attributes; None if these are not plain data."""
    known = attributes if isinstance(attributes, dict) else {}
    if "n" in known:
        return f"{known['n']} kinds"
    return f"shape {tuple(known['_shape'])}" if known.get("_shape") else None


def hand_written_algorithm(model: ModelFile) -> str | None:
    """The hand-written agent that a zip names, or None."""
    end = f":{model.data.get('algorithm')}"
    named = (name for name, entry in ALGORITHMS.items() if entry.entry_point.endswith(end))
    return next(filter(_is_hand_written, named), None)


def telling_masks(spec: TrainSpec, model: ModelFile) -> TrainSpec:
    """The spec with action masks, if the agent in a zip has them and the spec does not decide."""
    algorithm, name = spec.hyperparams.algorithm, "mask_actions"
    if name in algorithm or model.data.get(name) is not True:
        return spec
    hyperparams = replace(spec.hyperparams, algorithm={**algorithm, name: True})
    saved = {**spec.saved_hyperparams, name: True}
    return replace(spec, hyperparams=hyperparams, saved_hyperparams=saved)


def _is_hand_written(algo: str) -> bool:
    """Whether zips of the agent contain JSON; True if its class cannot be imported."""
    if ALGORITHMS[algo].family in _JSON_FAMILIES:
        return True
    from rl_yardstick.agents.common.model_files import JsonAlgorithm

    try:
        return issubclass(load_algorithm(algo), JsonAlgorithm)
    except ImportError:
        return True


def own_classes(
    algorithm: type[BaseAlgorithm], modules: Iterable[UserModule]
) -> Mapping[str, type]:
    """The user's networks, optimizers and buffers, by their full names."""
    from stable_baselines3.common.buffers import BaseBuffer
    from torch import nn, optim

    # No other classes: a file decides which of them are called, and with which arguments.
    kinds = (nn.Module, optim.Optimizer, BaseBuffer)
    homes = {module.name for module in modules} | {algorithm.__module__}

    def lies_in(name: str) -> bool:
        return any(f"{name}.".startswith(f"{home}.") for home in homes)

    found: dict[str, type] = {}
    for name, module in list(sys.modules.items()):
        if lies_in(name):
            for value in list(vars(module).values()):
                if isinstance(value, type) and issubclass(value, kinds):
                    found |= {f"{value.__module__}.{value.__qualname__}": value}
    return {name: cls for name, cls in found.items() if lies_in(cls.__module__)}


# Settings in a zip that may be classes of the user.
_CLASS_KEYS = ("policy_class", "policy_kwargs", "replay_buffer_class", "rollout_buffer_class")


def agent_class(algo: str) -> type[BaseAlgorithm]:
    """Import the class of an agent."""
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
    """Load an agent from its zip as data; ``kwargs`` are attributes to change."""
    file = model if isinstance(model, ModelFile) else read_model(model)
    algorithm = agent_class(algo)
    try:
        with warnings.catch_warnings():
            # The warning is about a buffer that the library itself chose.
            warnings.filterwarnings("ignore", r"`n_steps=\d+` is ignored because a custom")
            agent = _loaded(algorithm, file, env, modules, kwargs)
        agent.__class__ = algorithm
        return agent
    except UserError:
        raise
    except Exception as error:  # a file of another agent can fail anywhere in the library
        key, way_out = getattr(error, "key", None), ""
        if key in _CLASS_KEYS:
            way_out = "; to admit a class of yours, name its module"
            way_out += ": --gym-packages MODULE"
        elif key in algorithm_parameters(algorithm):
            value = "3e-4" if key == "learning_rate" else "VALUE"
            way_out = f"; train.py -i continues with another value: -params {key}:{value}"
        what = f"{file.path} cannot be loaded as a {algo} agent: {one_line(error)}"
        raise UserError(f"{what}{way_out}") from error


def _loaded(
    algorithm: type[BaseAlgorithm],
    file: ModelFile,
    env: VecEnv | None,
    modules: Iterable[UserModule],
    kwargs: Mapping[str, Any],
) -> BaseAlgorithm:
    """Load an agent by its class's own `load`, if it has one, or else as data."""
    from stable_baselines3.common.base_class import BaseAlgorithm

    from rl_yardstick.agents.common.model_files import JsonAlgorithm
    from rl_yardstick.safe_files.models import load_model

    if _is_load_of(JsonAlgorithm, algorithm):
        return algorithm.load(file.stream(), env=env, **kwargs)
    if not _is_load_of(BaseAlgorithm, algorithm):
        # The user's code, which may accept only paths.
        return algorithm.load(file.path, env=env, **kwargs)
    return load_model(
        _loadable(algorithm), file.stream(), env, classes=own_classes(algorithm, modules), **kwargs
    )


def _is_load_of(owner: type, algorithm: type[BaseAlgorithm]) -> bool:
    """Whether the class inherits `load` from ``owner``."""
    return getattr(algorithm.load, "__func__", None) is vars(owner)["load"].__func__


def _loadable(algorithm: type[BaseAlgorithm]) -> type[BaseAlgorithm]:
    """The class, or a subclass whose constructor accepts the arguments that `load` passes."""
    parameters = algorithm_parameters(algorithm)
    lacking = {"policy", "device", "_init_setup_model"} - parameters.keys()
    if not lacking:
        return algorithm

    def without_them(self: Any, **kwargs: Any) -> None:
        initialise: Any = algorithm.__init__
        # Replaces `_init_setup_model=False`: `load` sets up after restoring the attributes.
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
    """Like `load_model`, without buffers, noise and schedules; observation bounds may differ."""
    file = model if isinstance(model, ModelFile) else read_model(model)
    if _is_hand_written(algo):
        return load_model(algo, file, env, device=device)
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.utils import ConstantSchedule

    spaces = file.data.get("observation_space"), vars(env.observation_space)
    saved, given = map(_shown_space, spaces)
    if saved != given and saved is not None:
        raise UserError(
            f"{file.path} was trained on observations of {saved}, and the environment here gives "
            f"{given}: put the run's args.yml and config.yml beside the zip, or give the right "
            "--env-kwargs"
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
    """Load a replay buffer from a file into an agent, if the agent has replay buffers."""
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    from rl_yardstick.agents.library import MaskedReplayBuffer
    from rl_yardstick.safe_files.buffers_and_statistics import load_replay_buffer as load_safely
    from rl_yardstick.safe_files.files import MAX_BUFFER_BYTES

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
            f"{path} was filled by {buffer.n_envs} environments at once, and does not fit "
            f"{model.n_envs}: give -params n_envs:{buffer.n_envs}"
        )
    kinds = [(type(one).__name__, getattr(one, "n_steps", 1)) for one in (buffer, wanted)]
    if kinds[0] != kinds[1]:
        found, needed = (f"{name} with n_steps {n_steps}" for name, n_steps in kinds)
        raise UserError(f"{path} holds a {found}; these hyperparameters need a {needed}")


@dataclass(frozen=True)
class Statistics:
    """The statistics and settings of a VecNormalize."""

    path: Path  # the file that was read
    settings: Mapping[str, Any]  # arguments of VecNormalize
    # of observations, by key for Dict spaces; None if observations are not normalised
    observations: RunningMeanStd | dict[str, RunningMeanStd] | None
    returns: RunningMeanStd  # of discounted returns, by which rewards are divided


def read_statistics(path: Path, run: Run | None = None) -> Statistics:
    """Read the statistics that VecNormalize saved, as data: runs no code from the file."""
    from rl_yardstick.safe_files.buffers_and_statistics import read_normalization
    from rl_yardstick.safe_files.files import MAX_STATISTICS_BYTES

    try:
        saved = read_normalization(read_recorded(run, path, MAX_STATISTICS_BYTES))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error
    # NumPy's numbers become Python's, so that a settings file can store them.
    settings = {
        key: value.item() if hasattr(value, "item") else value
        for key, value in saved.settings.items()
        if key != "training" and value is not None
    }
    observations = saved.obs_rms if saved.settings["norm_obs"] else None
    return Statistics(path, settings, observations, saved.ret_rms)


def normalising(spec: TrainSpec, settings: Mapping[str, Any]) -> TrainSpec:
    """The spec with environments in a VecNormalize that is made with ``settings``."""
    return replace(
        spec,
        hyperparams=replace(spec.hyperparams, normalize=dict(settings)),
        saved_hyperparams={**spec.saved_hyperparams, "normalize": dict(settings)},
    )


def take_over(env: VecEnv, statistics: Statistics) -> None:
    """Copy the statistics into the VecNormalize of ``env``."""
    from stable_baselines3.common.vec_env import unwrap_vec_normalize

    normalization = unwrap_vec_normalize(env)
    assert normalization is not None, "see `normalising`"
    if normalization.norm_obs and statistics.observations is not None:
        wanted, found = (
            {key: value.mean.shape for key, value in rms.items()}
            if isinstance(rms, dict)
            else rms.mean.shape
            for rms in (normalization.obs_rms, statistics.observations)
        )
        if wanted != found:
            raise UserError(
                f"{statistics.path} holds statistics of observations of shape {found}; the "
                f"environment gives {wanted}"
            )
        normalization.obs_rms = statistics.observations  # type: ignore[assignment]
    normalization.ret_rms = statistics.returns


def with_normalised_rewards(env: VecEnv) -> VecEnv:
    """The environments with normalised rewards, as in training; returns are sums of these."""
    from stable_baselines3.common.vec_env import VecMonitor, unwrap_vec_normalize

    normalization = unwrap_vec_normalize(env)
    if normalization is None:
        raise UserError("--norm-reward: no statistics of VecNormalize belong to this model")
    normalization.norm_reward = True
    with warnings.catch_warnings():
        # Overwriting the statistics of the inner Monitor is intended.
        warnings.filterwarnings("ignore", "The environment is already wrapped with a `Monitor`")
        return VecMonitor(env)


def save_model(model: BaseAlgorithm, path: Path) -> None:
    """Write the agent to ``path`` atomically."""
    from rl_yardstick.pipeline.finite_numbers import check_model

    check_model(model)
    with replacing(path) as file:
        model.save(file)


def save_normalization(model: BaseAlgorithm, path: Path) -> None:
    """Write the running statistics of VecNormalize, if the agent trains in one."""
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        with replacing(path) as file:
            pickle.dump(normalization, file)  # like its own `save`, which accepts only paths


def save_replay_buffer(model: BaseAlgorithm, path: Path) -> None:
    """Write the agent's replay buffer, if it has one."""
    if getattr(model, "replay_buffer", None) is not None:
        with replacing(path) as file:
            model.save_replay_buffer(file)  # type: ignore[attr-defined]
