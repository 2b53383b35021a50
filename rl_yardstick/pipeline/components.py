"""Classes, schedules and other objects that plain values in hyperparameters stand for.

A name in a file can choose a class of a fixed kind from a fixed set of packages; it cannot import
or call anything else.
"""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path
from typing import Any

from rl_yardstick.pipeline.errors import UserError, did_you_mean, one_line, shown, unknown
from rl_yardstick.pipeline.modules import module_name
from rl_yardstick.pipeline.spec import Component, TrainSpec

# Names in files are looked up in these packages, and in modules that the user typed. Importing
# rl_zoo3 itself changes Gymnasium's time limits, so only two of its modules are among them.
PACKAGES = (
    *("rl_yardstick", "stable_baselines3", "sb3_contrib", "gymnasium", "torch.nn", "torch.optim"),
    *("rl_zoo3.wrappers", "rl_zoo3.callbacks"),
)
_SHORT = {"nn": "torch.nn", "th": "torch", "sb3": "stable_baselines3", "gym": "gymnasium"}
_SHORT |= {"optim": "torch.optim"}
_CLASSES = {
    "RMSpropTFLike": "stable_baselines3.common.sb2_compat.rmsprop_tf_like.RMSpropTFLike",
    "HerReplayBuffer": "stable_baselines3.her.her_replay_buffer.HerReplayBuffer",
}
_PLACES = re.compile(r"(path|dir|folder|file|filename|log|prefix)$")


def find_class(name: str, bases: tuple[type, ...], where: str, typed: list[str]) -> type:
    """The class of a dotted name, if it is a subclass of one of ``bases``.

    Args:
        name: such as ``nn.Tanh``.
        bases: the kinds that are admitted.
        where: begins every message.
        typed: modules of the user, where names are looked up too.

    Raises:
        UserError: if the name is not admitted, or there is no such class.
    """
    first, dot, rest = _CLASSES.get(name, name).partition(".")
    module, _, cls = f"{_SHORT.get(first, first)}{dot}{rest}".rpartition(".")
    packages = (*PACKAGES, *map(module_name, typed))
    if not any(f"{module}.".startswith(f"{package}.") for package in packages):
        fault = f"none of the packages that may be named ({', '.join(packages)})"
        raise UserError(f"{where}: {name} is in {fault}; admit others with --gym-packages")
    try:
        inside = importlib.import_module(module)
    except ImportError as error:
        raise UserError(f"{where}: {name}: {one_line(error)}") from error
    found = getattr(inside, cls, None)
    if isinstance(found, type) and issubclass(found, bases):
        return found
    wanted = " or ".join(base.__name__ for base in bases)
    known = [n for n, c in vars(inside).items() if isinstance(c, type) and issubclass(c, bases)]
    fault = "does not exist" if found is None else f"is no {wanted}"
    hint = did_you_mean(cls, known)
    raise UserError(f"{where}: {name} {fault}{': ' + hint if hint else ''}")


def build(
    component: Component,
    base: type,
    where: str,
    typed: list[str],
    folder: Path | None,
    *inner: Any,
) -> Any:
    """An object of a wrapper or callback, around ``inner``; it may write into ``folder`` alone."""
    from gymnasium.error import Error

    place = f"{where}: {component.name}"
    cls = find_class(component.name, (base,), where, typed)
    names = [*inspect.signature(cls).parameters]
    kwargs = {key: _inside(key, value, folder, place) for key, value in component.kwargs.items()}
    if folder is not None and "save_path" in names:
        kwargs.setdefault("save_path", str(folder))
    if "kwargs" not in names and (foreign := next((k for k in kwargs if k not in names), None)):
        raise unknown(f"{place}: unknown argument", foreign, names[len(inner) :])
    try:
        return cls(*inner, **build_value(kwargs, place, typed))
    except (TypeError, ValueError, AssertionError, Error) as error:
        raise UserError(f"{place}: {one_line(error)}") from error


def _inside(name: str, value: Any, folder: Path | None, where: str) -> Any:
    """A path among the arguments, inside the run folder."""
    if not (isinstance(value, str) and _PLACES.search(name)) or folder is None:
        return value
    if name.endswith("prefix"):
        if Path(value).name != value:
            raise UserError(f"{where}: {name} begins the names of files, unlike {shown(value)}")
        return value
    path = (folder / value).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise UserError(f"{where}: {name} must lie inside the run folder, unlike {shown(value)}")
    return str(path)


def build_value(value: Any, where: str, typed: list[str]) -> Any:
    """Nested values, with classes in place of dotted names such as ``nn.ReLU``."""
    if isinstance(value, dict):
        return {key: build_value(item, f"{where}: {key}", typed) for key, item in value.items()}
    if isinstance(value, list):
        return [build_value(item, where, typed) for item in value]
    is_name = isinstance(value, str) and re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+", value)
    if is_name or value in _CLASSES.values() or (isinstance(value, str) and value in _CLASSES):
        from stable_baselines3.common.buffers import BaseBuffer
        from torch import nn, optim

        return find_class(str(value), (nn.Module, optim.Optimizer, BaseBuffer), where, typed)
    return value


def schedule(text: str, for_library: bool) -> Any:
    """The schedule of ``lin_START``, ``lin_START_END`` or ``exp_START_END``.

    A library agent's zip must load without this project, so its schedules are the library's.
    """
    from stable_baselines3.common.utils import LinearSchedule

    from rl_yardstick.agents.common.schedules import ExponentialSchedule, library_schedule

    kind, *numbers = text.split("_")
    try:
        start, end = [*map(float, numbers), 0.0][:2]
        if kind == "lin":
            return LinearSchedule(start, end, 1.0)
        found = ExponentialSchedule(start, end)
    except ValueError as error:
        reason = one_line(error)
        raise UserError(f"{text} is no schedule such as lin_0.001 or exp_0.5_0.01: {reason}") from (
            error
        )
    return library_schedule(found) if for_library else found


def constructor_arguments(spec: TrainSpec, algorithm: type, is_dict: bool) -> dict[str, Any]:
    """The arguments of an agent's constructor, with objects in place of texts that name them.

    Args:
        spec: the training.
        algorithm: the agent's class.
        is_dict: whether observations are dictionaries, which decides the default policy.
    """
    from rl_yardstick.agents.common.model_files import JsonAlgorithm
    from rl_yardstick.pipeline.arguments import arguments_of

    for_library, kinds = not issubclass(algorithm, JsonAlgorithm), arguments_of(spec.algo)
    found: dict[str, Any] = {}
    for key, value in spec.algorithm.items():
        where = f"{spec.algo}: {key}"
        if (
            isinstance(value, str)
            and value.startswith(("lin_", "exp_"))
            and "str" not in kinds[key]
        ):
            found[key] = schedule(value, for_library)
        elif key == "train_freq" and isinstance(value, list):
            found[key] = tuple(value)
        elif key == "policy":
            found[key] = _policy(spec, algorithm, value)
        else:
            found[key] = build_value(value, where, spec.gym_packages)
    if "policy" in kinds and "policy" not in found:
        prefix = "MultiInput" if is_dict else "Mlp"
        known: list[str] = [*getattr(algorithm, "policy_aliases", {})]
        fitting = (name for name in known if name.startswith(prefix))
        found["policy"] = next(fitting, next(iter(known), f"{prefix}Policy"))
    return found


def _policy(spec: TrainSpec, algorithm: Any, name: Any) -> Any:
    """The policy's name, or its class."""
    from stable_baselines3.common.policies import BasePolicy

    where, known = f"{spec.algo}: policy", algorithm.policy_aliases
    if "." in str(name):
        return find_class(str(name), (BasePolicy,), where, spec.gym_packages)
    if known and name not in known:
        raise unknown(f"{spec.algo}: unknown policy", str(name), known)
    return name


def action_noise(spec: TrainSpec, actions: Any) -> dict[str, Any]:
    """The argument ``action_noise``, for actions scaled to [-1, 1]; empty without noise."""
    if spec.noise_type is None:
        return {}
    import numpy as np
    from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

    kinds = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
    mean = np.zeros(actions.shape or ())
    return {"action_noise": kinds[spec.noise_type](mean, np.full_like(mean, spec.noise_std))}
