"""What an entry of hyperparameters says: checked strictly, and never run.

An entry is in rl_zoo3's format, see `pipeline.settings.hyperparam_entries`. It holds arguments of
the algorithm's constructor, and the special keys that `Hyperparams` lists.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any, Literal, get_type_hints

from pipeline.errors import UserError, shown
from pipeline.settings.coercion import coerce
from pipeline.settings.constructor_arguments import check_arguments, check_range
from pipeline.settings.literals import contains_name

# Constructor arguments that are set elsewhere, and how.
_SET_ELSEWHERE = {
    "action_noise": "noise_type and noise_std",
    "env": "--env",
    "seed": "--seed",
    "device": "--device",
    "verbose": "--verbose",
    "tensorboard_log": "--tensorboard-log",
}
_INTERNAL = ("self", "_init_setup_model")

_WRAPPERS = ("env_wrapper", "train_env_wrapper", "vec_env_wrapper", "callback")
_KEYWORDS: Mapping[str, Mapping[str, Any]] = {
    "normalize": {
        "training": bool,
        "norm_obs": bool,
        "norm_reward": bool,
        "clip_obs": float,
        "clip_reward": float,
        "gamma": float,
        "epsilon": float,
        "norm_obs_keys": list[str] | None,
    },
    "monitor_kwargs": {
        "allow_early_resets": bool,
        "reset_keywords": tuple[str, ...],
        "info_keywords": tuple[str, ...],
        "override_existing": bool,
    },
}


@dataclass(frozen=True)
class ComponentSpec:
    """A wrapper or callback that an entry asks for.

    Attributes:
        name: the dotted name of its class.
        kwargs: arguments of its constructor.
    """

    name: str
    kwargs: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Hyperparams:
    """One entry, the special keys apart from the algorithm's arguments.

    Attributes:
        n_timesteps: environment steps to train for; None if counted in episodes or not said.
        n_episodes: episodes to train for; never set together with ``n_timesteps``.
        n_envs: environments to train on at once.
        normalize: arguments of VecNormalize, the algorithm's ``gamma`` included; None for without.
        env_wrapper: wrappers of every environment, the innermost first.
        train_env_wrapper: wrappers of the training environments alone, around those.
        vec_env_wrapper: wrappers of the vectorised environment.
        callback: callbacks of the training.
        env_kwargs: arguments of every environment.
        train_env_kwargs: further arguments of the training environments alone.
        eval_env_kwargs: further arguments of the evaluation environments alone.
        frame_stack: how many observations to stack, or None.
        monitor_kwargs: arguments of Monitor.
        noise_type: action noise, for algorithms that take an ``action_noise``.
        noise_std: its standard deviation. Without a ``noise_type`` the key is an argument of the
            algorithm like any other.
        flush_denormal: let the processor take numbers below 1e-38 for zero.
        algorithm: everything else: arguments of the algorithm's constructor, not checked yet.
    """

    n_timesteps: int | None = None
    n_episodes: int | None = None
    n_envs: int = 1
    normalize: dict[str, Any] | None = None
    env_wrapper: tuple[ComponentSpec, ...] = ()
    train_env_wrapper: tuple[ComponentSpec, ...] = ()
    vec_env_wrapper: tuple[ComponentSpec, ...] = ()
    callback: tuple[ComponentSpec, ...] = ()
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    train_env_kwargs: dict[str, Any] = field(default_factory=dict)
    eval_env_kwargs: dict[str, Any] = field(default_factory=dict)
    frame_stack: int | None = None
    monitor_kwargs: dict[str, Any] = field(default_factory=dict)
    noise_type: Literal["normal", "ornstein-uhlenbeck"] | None = None
    noise_std: float | None = None
    flush_denormal: bool = False
    algorithm: dict[str, Any] = field(default_factory=dict)


SPECIAL_KEYS = tuple(key.name for key in fields(Hyperparams) if key.name != "algorithm")


@cache  # they stand there as texts, which take longer to evaluate than the rest of an entry
def _special_key_types() -> Mapping[str, Any]:
    return get_type_hints(Hyperparams)


def split(entry: Mapping[str, Any], where: str = "hyperparameters") -> Hyperparams:
    """Tell the special keys of an entry from the algorithm's arguments, and check them.

    Args:
        entry: as `pipeline.settings.hyperparam_entries.read_hyperparams` returns it. A special key
            that is null counts as left out.
        where: begins every error message.

    Raises:
        UserError: if a special key has a wrong type or range, or contradicts another.
    """
    special_keys = _special_keys(entry)
    algorithm = {key: value for key, value in entry.items() if key not in special_keys}
    special = {key: value for key in special_keys if (value := entry.get(key)) is not None}
    if isinstance(special.get("normalize"), bool):
        special["normalize"] = {} if special["normalize"] else None
    hints = _special_key_types()
    for key, value in special.items():
        if key in _WRAPPERS:
            special[key] = component_specs(value, f"{where}: {key}")
        else:
            special[key] = coerce(value, hints[key], f"{where}: {key}")
        check_range(key, special[key], where)
        if isinstance(special[key], dict):
            special[key] = _checked_keywords(key, special[key], where)
    if "n_timesteps" in special and "n_episodes" in special:
        raise UserError(f"{where}: give n_timesteps or n_episodes, not both")
    if "noise_type" in special and "noise_std" not in special:
        raise UserError(f"{where}: noise_type needs noise_std, the standard deviation of the noise")
    if special.get("normalize") is not None and "gamma" in algorithm:
        # As rl_zoo3 has it: rewards are normalised under the discount that the agent uses.
        gamma = coerce(algorithm["gamma"], float, f"{where}: gamma")
        special["normalize"].setdefault("gamma", gamma)
    return Hyperparams(**special, algorithm=algorithm)


def _special_keys(entry: Mapping[str, Any]) -> list[str]:
    # Some agents have a noise_std of their own, on what they learn rather than on actions.
    is_action_noise = entry.get("noise_type") is not None
    return [key for key in SPECIAL_KEYS if key != "noise_std" or is_action_noise]


def component_specs(spec: Any, where: str) -> tuple[ComponentSpec, ...]:
    """Read wrappers or callbacks in rl_zoo3's forms.

    Args:
        spec: the dotted name of a class, a mapping from it to its arguments, a list of either, or
            what this function returned before.
        where: begins every error message.

    Raises:
        UserError: if the form is another.
    """
    items = spec if isinstance(spec, list | tuple) else [] if spec is None else [spec]
    return tuple(_component_spec(item, where) for item in items)


def _component_spec(item: Any, where: str) -> ComponentSpec:
    if isinstance(item, ComponentSpec):
        return item
    if isinstance(item, dict) and len(item) == 1:
        ((name, kwargs),) = item.items()
    else:
        name, kwargs = item, None
    kwargs = {} if kwargs is None else kwargs
    if not (isinstance(name, str) and isinstance(kwargs, dict) and set(map(type, kwargs)) <= {str}):
        raise UserError(
            f"{where} must be the dotted name of a class, or that name with its arguments indented "
            f"below it, or a list of such; not {shown(item)}"
        )
    return ComponentSpec(name, kwargs)


def _checked_keywords(key: str, keywords: dict[str, Any], where: str) -> dict[str, Any]:
    if contains_name(keywords):
        raise UserError(f"{where}: {key} takes plain values, not names: put quotes around texts")
    if key not in _KEYWORDS:
        return keywords
    parameters = {
        name: inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation)
        for name, annotation in _KEYWORDS[key].items()
    }
    return check_arguments(keywords, parameters, f"{where}: {key}")


def check_algorithm_kwargs(
    kwargs: Mapping[str, Any], parameters: Mapping[str, inspect.Parameter], where: str
) -> dict[str, Any]:
    """Check constructor arguments by name, type and range.

    Args:
        kwargs: the arguments as they stand in a file, such as `Hyperparams.algorithm`.
        parameters: those of the constructor, see
            `pipeline.settings.constructor_arguments.constructor_parameters`.
        where: begins every error message.

    Returns:
        The arguments as their annotations ask for; classes as `DottedName` and schedules as
        `ScheduleSpec`, which `pipeline.settings.components.build_value` turns into objects.

    Raises:
        UserError: naming the argument, and what it must be.
    """
    for name in kwargs:
        if name in _SET_ELSEWHERE and name in parameters:
            raise UserError(f"{where}: {name} is set by {_SET_ELSEWHERE[name]}, not here")
    known = {
        name: parameter
        for name, parameter in parameters.items()
        if name not in _SET_ELSEWHERE and name not in _INTERNAL
    }
    if "noise_std" in kwargs and "noise_std" not in known:
        raise UserError(f"{where}: noise_std needs noise_type: normal or ornstein-uhlenbeck")
    result = check_arguments(kwargs, known, where, "hyperparameter", SPECIAL_KEYS)
    for name, value in result.items():
        check_range(name, value, where)
    return result
