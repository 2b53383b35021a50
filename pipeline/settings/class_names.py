"""Classes by their dotted names, from a fixed set of packages and of a fixed kind only.

A name in a file can choose among classes; it cannot make anything else be imported or called.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from types import ModuleType

from pipeline.errors import UserError, did_you_mean

# Of rl_zoo3 only what its files name: importing it changes Gymnasium's time limit.
_PACKAGES = (
    "stable_baselines3",
    "sb3_contrib",
    "gymnasium",
    "torch.nn",
    "torch.optim",
    "rl_zoo3.wrappers",
    "rl_zoo3.callbacks",
    "envs",
    "agents",
    "pipeline",
)

# The short names that rl_zoo3's files use.
_MODULE_ALIASES = {"nn": "torch.nn", "th": "torch", "sb3": "stable_baselines3", "gym": "gymnasium"}
_CLASS_ALIASES = {
    "RMSpropTFLike": "stable_baselines3.common.sb2_compat.rmsprop_tf_like.RMSpropTFLike",
    "HerReplayBuffer": "stable_baselines3.her.her_replay_buffer.HerReplayBuffer",
    # Where classes of ours were before: files that name them so are still read.
    "envs.wrappers.encodings.FlattenToDiscrete": "envs.wrappers.FlattenToDiscrete",
    "envs.wrappers.encodings.OneHotObservation": "envs.wrappers.OneHotObservation",
    "envs.wrappers.rewards.ScaleReward": "envs.wrappers.ScaleReward",
    "envs.wrappers.rewards.TerminationReward": "envs.wrappers.TerminationReward",
}


def find_class(
    name: str, bases: tuple[type, ...], where: str, extra_packages: Sequence[str] = ()
) -> type:
    """Import a class.

    Args:
        name: such as ``nn.Tanh`` or ``stable_baselines3.common.monitor.Monitor``.
        bases: it must be a subclass of one of these.
        where: begins every error message.
        extra_packages: packages that the user allows besides the usual ones.

    Raises:
        UserError: if the name is not admitted, does not exist, or is no such class.
    """
    module_name, _, class_name = _full_name(name).rpartition(".")
    parts = [*module_name.split("."), class_name]
    if not all(part.isidentifier() and not part.startswith("_") for part in parts):
        raise UserError(f"{where}: {name!r} is not the dotted name of a class")
    packages = (*_PACKAGES, *extra_packages)
    if not any(f"{module_name}.".startswith(f"{package}.") for package in packages):
        raise UserError(
            f"{where}: {name} is in none of the packages that may be named "
            f"({', '.join(packages)}); admit others with --gym-packages"
        )
    module = _import(module_name, f"{where}: {name}")
    found = getattr(module, class_name, None)
    if isinstance(found, type) and issubclass(found, bases):
        return found
    wanted = " or ".join(base.__name__ for base in bases)
    fault = "does not exist" if found is None else f"is no {wanted}"
    hint = did_you_mean(class_name, _classes(module, bases))
    raise UserError(f"{where}: {name} {fault}{': ' + hint if hint else ''}")


def _full_name(name: str) -> str:
    first, dot, rest = _CLASS_ALIASES.get(name, name).partition(".")
    return _MODULE_ALIASES.get(first, first) + dot + rest


def _import(module_name: str, what: str) -> ModuleType:
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise UserError(
            f"{what}: there is no module {error.name}, or it is not installed"
        ) from error
    except ImportError as error:
        raise UserError(f"{what}: cannot be imported: {error}") from error


def _classes(module: ModuleType, bases: tuple[type, ...]) -> list[str]:
    return [
        name
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, bases) and value not in bases
    ]
