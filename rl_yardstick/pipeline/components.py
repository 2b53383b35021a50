"""Names that become objects: classes, schedules and noise in hyperparameters, and typed modules.

A name in a file can choose a class of a fixed kind from a fixed set of packages; it cannot import
or call anything else. Modules of the user are imported because their names were typed.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rl_yardstick.pipeline.errors import UserError, did_you_mean, one_line, shown, unknown
from rl_yardstick.pipeline.spec import Component, TrainSpec

# Names in files are looked up in these packages, and in modules that the user typed. Importing
# rl_zoo3 itself changes Gymnasium's time limits, so only two of its modules are among them.
PACKAGES = (
    *("rl_yardstick", "stable_baselines3", "sb3_contrib", "gymnasium", "torch.nn", "torch.optim"),
    *("rl_zoo3.wrappers", "rl_zoo3.callbacks"),
)
_SHORT = {"nn": "torch.nn", "th": "torch", "optim": "torch.optim"}
_SHORT |= {"sb3": "stable_baselines3", "gym": "gymnasium"}
_CLASSES = {
    "RMSpropTFLike": "stable_baselines3.common.sb2_compat.rmsprop_tf_like.RMSpropTFLike",
    "HerReplayBuffer": "stable_baselines3.her.her_replay_buffer.HerReplayBuffer",
}
_PLACES = re.compile(r"(path|dir|folder|file|filename|log|prefix)$")
_DOTTED = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+")


# --- modules of the user --------------------------------------------------------------------------


def import_modules(typed: Iterable[str]) -> None:
    """Import modules by name or by file; the current folder comes first, as with ``python -m``.

    Without any name the current folder is not searched: it may be a stranger's.
    """
    for name in typed:
        if str(Path.cwd()) not in sys.path[:1]:
            sys.path.insert(0, str(Path.cwd()))
        try:
            if name.endswith(".py") or "/" in name:
                _import_file(Path(name).expanduser())
            else:
                importlib.import_module(name)
        except UserError:
            raise
        except ModuleNotFoundError as error:
            raise UserError(f"--gym-packages {name}: no module named {error.name}") from error
        except (Exception, SystemExit) as error:  # an import may raise anything
            last = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{last.filename}:{last.lineno}"
            raise UserError(f"--gym-packages {name}: {place}: {one_line(error)}") from error


def _import_file(path: Path) -> None:
    file = path / "__init__.py" if path.is_dir() else path
    if not file.is_file():
        raise UserError(f"--gym-packages {path}: no such file")
    module = file.parent if file.name == "__init__.py" else file.with_suffix("")
    loaded = sys.modules.get(module.name)
    if loaded is None:
        sys.path.insert(0, str(module.parent.resolve()))  # what lies beside it can be imported too
        importlib.import_module(module.name)
    elif Path(getattr(loaded, "__file__", None) or "").resolve() != file.resolve():
        fault = f"another module is named {module.name}; rename it"
        raise UserError(f"--gym-packages {path}: {fault}")


def module_name(typed: str) -> str:
    """The name under which `import_modules` has imported what was typed."""
    return Path(typed).stem if typed.endswith(".py") or "/" in typed else typed


def split_id(env_id: str) -> tuple[str, str]:
    """The module and the id in ``module:Env-v0``, Gymnasium's form; an empty module without it."""
    module, _, name = env_id.rpartition(":")
    return module, name


def check_typed(recorded: Iterable[str], typed: Iterable[str], where: str) -> None:
    """Raise UserError if a module that a file names is missing among those that were typed."""
    known = {module_name(name) for name in typed}
    missing = [name for name in recorded if module_name(name) not in known]
    if missing:
        what = f"was made with modules of yours: add --gym-packages {' '.join(missing)}"
        raise UserError(f"{where} {what}")


# --- classes, and what they are built from --------------------------------------------------------


def find_class(name: str, bases: tuple[type, ...], where: str, typed: list[str]) -> type:
    """The class of a dotted name such as ``nn.Tanh``, if it is a subclass of one of ``bases``.

    Names are looked up in the ``typed`` modules of the user too. Raises UserError if the name is
    not admitted, or there is no such class.
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
    fault, hint = "does not exist" if found is None else f"is no {wanted}", did_you_mean(cls, known)
    raise UserError(f"{where}: {name} {fault}{': ' + hint if hint else ''}")


def build(
    component: Component, base: type, where: str, typed: list[str], folder: Path | None, *inner: Any
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
    path, is_prefix = (folder / value).resolve(), name.endswith("prefix")
    if is_prefix and Path(value).name != value:
        raise UserError(f"{where}: {name} begins the names of files, unlike {shown(value)}")
    if not path.is_relative_to(folder.resolve()):
        raise UserError(f"{where}: {name} must lie inside the run folder, unlike {shown(value)}")
    return value if is_prefix else str(path)


def build_value(value: Any, where: str, typed: list[str]) -> Any:
    """Nested values, with classes in place of dotted names such as ``nn.ReLU``."""
    if isinstance(value, dict):
        return {key: build_value(item, f"{where}: {key}", typed) for key, item in value.items()}
    if isinstance(value, list):
        return [build_value(item, where, typed) for item in value]
    if not isinstance(value, str) or (value not in _CLASSES and not _DOTTED.fullmatch(value)):
        return value
    from stable_baselines3.common.buffers import BaseBuffer
    from torch import nn, optim

    return find_class(value, (nn.Module, optim.Optimizer, BaseBuffer), where, typed)


# --- the arguments of an agent --------------------------------------------------------------------


def constructor_arguments(spec: TrainSpec, algorithm: Any, is_dict: bool) -> dict[str, Any]:
    """The arguments of an agent's constructor, with objects in place of texts that name them.

    ``is_dict``: whether observations are dictionaries, which decides the default policy.
    """
    from stable_baselines3.common.policies import BasePolicy

    from rl_yardstick.agents.common.model_files import JsonAlgorithm
    from rl_yardstick.pipeline.arguments import arguments_of

    for_library, kinds = not issubclass(algorithm, JsonAlgorithm), arguments_of(spec.algo)
    policies = list(getattr(algorithm, "policy_aliases", {}))
    found: dict[str, Any] = {}
    for key, value in spec.algorithm.items():
        where, text = f"{spec.algo}: {key}", str(value)
        if text.startswith(("lin_", "exp_")) and "str" not in kinds[key]:
            found[key] = schedule(text, for_library)
        elif key == "train_freq" and isinstance(value, list):
            found[key] = tuple(value)
        elif key == "policy" and "." in text:
            found[key] = find_class(text, (BasePolicy,), where, spec.gym_packages)
        elif key == "policy" and policies and value not in policies:
            raise unknown(f"{spec.algo}: unknown policy", text, policies)
        else:
            found[key] = build_value(value, where, spec.gym_packages)
    if "policy" in kinds and "policy" not in found:
        prefix = "MultiInput" if is_dict else "Mlp"
        fitting = [name for name in policies if name.startswith(prefix)]
        found["policy"] = [*fitting, *policies, f"{prefix}Policy"][0]
    return found


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
        fault = f"{text} is no schedule such as lin_0.001 or exp_0.5_0.01: {one_line(error)}"
        raise UserError(fault) from error
    return library_schedule(found) if for_library else found


def action_noise(spec: TrainSpec, actions: Any) -> dict[str, Any]:
    """The argument ``action_noise``, for actions scaled to [-1, 1]; empty without noise."""
    if spec.noise_type is None:
        return {}
    import numpy as np
    from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

    kinds = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
    mean = np.zeros(actions.shape or ())
    return {"action_noise": kinds[spec.noise_type](mean, np.full_like(mean, spec.noise_std))}
