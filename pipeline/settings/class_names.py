"""Classes by their dotted names, from a fixed set of packages and of a fixed kind only.

A name in a file can choose among classes; it cannot make anything else be imported or called. A
module is imported only if it is one of ours, if its name was typed, or if its file is in the record
of a distribution that is installed: a folder ``rl_zoo3`` of a stranger's is none, wherever it lies.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import site
import sysconfig
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType

from pipeline.errors import UserError, did_you_mean
from pipeline.user_modules import is_ours

# The libraries that this project cannot do without: where they lie, packages are installed.
_REQUIRED = ("stable_baselines3", "gymnasium", "torch")

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
    module = _import(module_name, f"{where}: {name}", extra_packages)
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


def _import(module_name: str, what: str, typed: Sequence[str]) -> ModuleType:
    """Import a module, after each package that it lies in has been looked at."""
    parts = module_name.split(".")
    try:
        for end in range(1, len(parts) + 1):
            name = ".".join(parts[:end])
            if not (is_ours(name) or _is_typed(name, typed) or _is_installed(name)):
                raise UserError(
                    f"{what}: {name} belongs to no package that is installed; if you trust it, "
                    f"type --gym-packages {parts[0]}"
                )
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise UserError(
            f"{what}: there is no module {error.name}, or it is not installed"
        ) from error
    except ImportError as error:
        raise UserError(f"{what}: cannot be imported: {error}") from error


def _is_typed(name: str, typed: Sequence[str]) -> bool:
    """Whether a module was typed, lies in a package that was, or is one around it."""
    return any(
        f"{name}.".startswith(f"{one}.") or f"{one}.".startswith(f"{name}.") for one in typed
    )


def _is_installed(name: str) -> bool:
    """Whether a module's file is in the record of the installed distribution of that name.

    The packages around it are imported, so they have to be looked at before.

    Raises:
        ModuleNotFoundError: if there is no such module.
    """
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # somebody has put an object of another kind in its place
        return False
    if spec is None:
        raise ModuleNotFoundError(name=name)
    folder = next((each for each in _folders() if _is_below(spec.origin, each)), None)
    if spec.origin is None or folder is None:
        return False
    return Path(spec.origin).relative_to(folder).as_posix() in _record(
        name.partition(".")[0], folder
    )


def _is_below(origin: str | None, folder: Path) -> bool:
    return origin is not None and Path(origin).is_relative_to(folder)


@cache
def _folders() -> tuple[Path, ...]:
    """Where packages are installed; neither the current folder nor PYTHONPATH is such a place."""
    paths = sysconfig.get_paths()
    places = [paths["purelib"], paths["platlib"], *site.getsitepackages()]
    places += [site.getusersitepackages()] if site.ENABLE_USER_SITE else []
    found = {name: importlib.util.find_spec(name) for name in _REQUIRED}
    beside = {
        name: Path(spec.origin).parents[1] for name, spec in found.items() if spec and spec.origin
    }
    required = [one for name, one in beside.items() if f"{name}/__init__.py" in _record(name, one)]
    return tuple(dict.fromkeys([*required, *map(Path, places)]))


@cache
def _record(distribution: str, folder: Path) -> frozenset[str]:
    """The files of a distribution that is installed in a folder, relative to it."""
    found = importlib.metadata.distributions(name=distribution, path=[str(folder)])
    texts = [one.read_text("RECORD") or "" for one in found]
    return frozenset(line.rsplit(",", 2)[0] for text in texts for line in text.splitlines())


def _classes(module: ModuleType, bases: tuple[type, ...]) -> list[str]:
    return [
        name
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, bases) and value not in bases
    ]
