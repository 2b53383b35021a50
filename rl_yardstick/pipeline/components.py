"""What stands in hyperparameters: arguments of constructors, and names that become objects.

A name in a file can choose a class of a fixed kind from a fixed set of packages; it cannot import
or call anything else. Modules of the user are imported because their names were typed.

Importing an agent takes two seconds, for torch. So the signatures of the registered agents stand in
``hyperparams/arguments.json``, which a test compares with the classes; after a change run
``python -m rl_yardstick.pipeline.components``. Agents that are not in it are imported.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import json
import math
import re
import sys
import traceback
import typing
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, Literal

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from pydantic import Field, TypeAdapter, ValidationError

from rl_yardstick.agents.registry import ALGORITHMS, BY_VALUE, add_class
from rl_yardstick.pipeline.errors import (
    UserError,
    as_user_error,
    did_you_mean,
    one_line,
    shown,
    unknown,
)
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
        module, cls = split_class(name)
        try:
            if module.endswith(".py") or "/" in module:
                _import_file(Path(module).expanduser())
            else:
                importlib.import_module(module)
            if cls:
                _register(name, cls, vars(sys.modules[module_name(name)]))
        except UserError:
            raise
        except ModuleNotFoundError as error:
            raise UserError(f"{name}: no module named {error.name}") from error
        except (Exception, SystemExit) as error:  # an import may raise anything
            frame = traceback.extract_tb(error.__traceback__)[-1]
            at: Any = error if isinstance(error, SyntaxError) else frame
            what = f"{at.filename}:{at.lineno}: {type(error).__name__}: {one_line(error)}"
            raise UserError(f"{name}: {what}") from error


def split_class(typed: str) -> tuple[str, str]:
    """The module or file, and the class, in ``module:Class``; without one, an empty text."""
    module, _, cls = typed.rpartition(":")
    return (module, cls) if module and cls.isidentifier() else (typed, "")


def class_name(typed: str) -> str:
    """The name ``module.Class`` of a class that is typed; or else that of the module."""
    cls = split_class(typed)[1]
    return f"{module_name(typed)}.{cls}" if cls else module_name(typed)


def _register(typed: str, cls: str, inside: dict[str, Any]) -> None:
    """Register a class as an agent, or as an environment if it cannot be trained."""
    if cls not in inside and cls not in gym.registry:  # an id without a version
        known = [name for name, value in inside.items() if isinstance(value, type)]
        raise unknown(f"{typed}: there is no class", cls, known)
    name, place = class_name(typed), f"{module_name(typed)}:{cls}"
    try:
        add_class(name, inside.get(cls))
    except ValueError:  # where it is asked for as an agent, `settings.check_agent` has the reason
        gym.registry[name] = gym.registry.get(cls) or EnvSpec(name, place)


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
    module, _ = split_class(typed)
    return Path(module).stem if module.endswith(".py") or "/" in module else module


def digests_of(typed: Iterable[str], *names: str) -> dict[str, str]:
    """A digest of the sources of each imported module of the user, and of given classes, by name.

    ``names`` are of agents and environments, whose classes may stand in no module.
    """
    found = {}
    for name in names:
        one = BY_VALUE.get(name) or getattr(gym.registry.get(name), "entry_point", None)
        made = getattr(one, "args", (one,))[0]  # of an object, which is copied
        cls = made if isinstance(made, type) else type(made)
        with suppress(OSError):  # of a class that was typed into a console
            methods = filter(inspect.isfunction, vars(cls).values())
            if source := "".join(map(inspect.getsource, methods)):
                found[name] = hashlib.sha256(source.encode()).hexdigest()[:12]
    for name in map(module_name, typed):
        file = Path(getattr(sys.modules.get(name), "__file__", None) or "")
        files = sorted(file.parent.rglob("*.py")) if file.name == "__init__.py" else [file]
        sources = b"".join(one.read_bytes() for one in files if one.is_file())
        found[name] = hashlib.sha256(sources).hexdigest()[:12]
    return found


def check_code(spec: TrainSpec, where: str) -> None:
    """Raise UserError if the user's classes are not there, or have changed since a training."""
    here = digests_of(spec.gym_packages)
    if changed := [name for name in here if spec.code.get(name, here[name]) != here[name]]:
        raise UserError(f"{where} was begun with other code of {', '.join(changed)}")
    if spec.algo not in ALGORITHMS or spec.env_id not in gym.registry:
        fault = "was begun in Python, with classes of a script or notebook"
        raise UserError(f"{where} {fault}: the same call of compare there continues a study")


def split_id(env_id: str) -> tuple[str, str]:
    """What to import for ``module:Env-v0``, Gymnasium's form, or ``module:Class``; and the id."""
    module, _, name = env_id.rpartition(":")
    return (env_id, class_name(env_id)) if split_class(env_id)[1] else (module, name)


def check_typed(recorded: Iterable[str], typed: Iterable[str], where: str) -> None:
    """Raise UserError if a module that a file names is missing among those that were typed."""
    known = {name(one) for one in typed for name in (class_name, module_name)}
    missing = [name for name in recorded if class_name(name) not in known]
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
    with as_user_error(f"{where}: {name}", ImportError):
        inside = importlib.import_module(module)
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
    place = f"{where}: {component.name}"
    cls = find_class(component.name, (base,), where, typed)
    names = [*inspect.signature(cls).parameters]
    kwargs = {key: _inside(key, value, folder, place) for key, value in component.kwargs.items()}
    if folder is not None and "save_path" in names:
        kwargs.setdefault("save_path", str(folder))
    if "kwargs" not in names and (foreign := next((k for k in kwargs if k not in names), None)):
        raise unknown(f"{place}: unknown argument", foreign, names[len(inner) :])
    with as_user_error(place, TypeError, ValueError, AssertionError, gym.error.Error):
        return cls(*inner, **build_value(kwargs, place, typed))


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
    with as_user_error(f"{text} is no schedule such as lin_0.001 or exp_0.5_0.01", ValueError):
        start, end = [*map(float, numbers), 0.0][:2]
        if kind == "lin":
            return LinearSchedule(start, end, 1.0)
        found = ExponentialSchedule(start, end)
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


# --- signatures, and the check of values against them ---------------------------------------------

TABLE = Path(__file__).parents[1] / "hyperparams" / "arguments.json"

# Arguments that a flag or another key sets; rl_zoo3's files have some of them.
SET_ELSEWHERE = {
    "action_noise": "noise_type and noise_std",
    "tensorboard_log": "--tensorboard-log",
    "seed": "--seed",
    "device": "--device",
    "verbose": "--verbose",
}
_INTERNAL = {"self", "env", "_init_setup_model", "venv", "filename"}
_PLAIN = {"bool": bool, "int": int, "float": float, "str": str, "dict": dict, "list": list}
_WORDS = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "a text"}
_WORDS |= {"schedule": "a schedule such as lin_0.001", "dict": "a mapping", "list": "a list"}
_WORDS |= {"None": "none"}

# Ranges that hold for every agent; an agent's own checks come when it is made.
_SHARE, _COUNT, _POSITIVE = Field(ge=0, le=1), Field(ge=1, le=2**62), Field(ge=0)
_RANGES = {
    "gamma gae_lambda tau": _SHARE,
    "exploration_fraction exploration_initial_eps exploration_final_eps": _SHARE,
    "n_steps batch_size n_epochs buffer_size train_freq": _COUNT,
    "target_update_interval stats_window_size": _COUNT,
    "learning_starts temperature vf_coef target_kl clip_range": _POSITIVE,
    "clip_range_vf rms_prop_eps max_grad_norm": _POSITIVE,
    "gradient_steps sde_sample_freq": Field(ge=-1),  # -1: each step, never
    # Larger rates overflow single precision in the first update.
    "learning_rate": Field(ge=0, le=1e37),
}
_RANGE_OF: dict[str, Any] = {name: r for names, r in _RANGES.items() for name in names.split()}
AUTO = ("gamma", "learning_rate", "initial_q", "value_bound")  # which may be ``auto``
# Keys of an entry that hold arguments of a class of the library's.
WRAPPERS = {
    "normalize": "stable_baselines3.common.vec_env:VecNormalize",
    "monitor_kwargs": "stable_baselines3.common.monitor:Monitor",
}


@cache
def _table() -> dict[str, dict[str, list[str]]]:
    return json.loads(TABLE.read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def arguments_of(algo: str) -> dict[str, list[str]]:
    """The arguments that hyperparameters may set: names, and the kinds of value each takes."""
    return _table()[algo] if algo in _table() else read_signature(algo)


def known_names() -> set[str]:
    """The arguments of all registered agents."""
    return {name for algo in _table().keys() - WRAPPERS for name in _table()[algo]}


def read_signature(name: str) -> dict[str, list[str]]:
    """Import the class of an agent, or of a key of `WRAPPERS`, and read its signature."""
    from rl_yardstick.agents import load_algorithm

    cls = resolve_name(WRAPPERS[name]) if name in WRAPPERS else load_algorithm(name)
    found = constructor_parameters(cls)
    kinds = {name: sorted(_kinds(p.annotation, p.default)) for name, p in found.items()}
    return {name: kinds[name] for name in kinds if name not in {*SET_ELSEWHERE, *_INTERNAL}}


def constructor_parameters(cls: type) -> dict[str, inspect.Parameter]:
    """The arguments of a constructor, with those that ``**kwargs`` passes to base classes."""
    try:
        signature = inspect.signature(cls, eval_str=True)
    except (NameError, TypeError, AttributeError):  # some annotations are for type checkers alone
        signature = inspect.signature(cls)
    parameters = signature.parameters.values()
    named = {p.name: p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
    owners = [base for base in cls.__mro__[:-1] if "__init__" in vars(base)]
    if any(p.kind is p.VAR_KEYWORD for p in parameters) and len(owners) > 1:
        inherited = constructor_parameters(owners[1])
        if "env" in named and "policy" not in named:
            inherited.pop("policy", None)  # the constructor passes it itself
        named = {**inherited, **named}
    return named


def _kinds(annotation: Any, default: Any = None) -> set[str]:
    """The kinds of plain value that an annotation admits; ``any`` for classes and the unknown."""
    if annotation in (None, type(None)):
        return {"None"}
    if annotation is inspect.Parameter.empty and type(default) in (int, float):
        annotation = type(default)
    origin, members = typing.get_origin(annotation), typing.get_args(annotation)
    name = getattr(origin or annotation, "__name__", "")
    if name in _PLAIN:
        return {name}
    if origin is Literal:
        return {f"={word}" for word in members}
    if origin is Sequence:
        return {"list"}
    if Callable in (annotation, origin):
        return {"schedule"}
    if members and origin not in (type, tuple):
        return set().union(*map(_kinds, members))
    return {"any"}


def check_arguments(owner: str, values: Any, where: str = "") -> dict[str, Any]:
    """The values of constructor arguments, each of its type (``"1e-4"`` becomes a number).

    ``owner`` is an agent, or a key of `WRAPPERS`; ``where`` begins every message. Raises UserError
    for an argument that does not exist, or a value that is not of its type or range.
    """
    if not isinstance(values, dict):
        raise UserError(f"{owner} must be a mapping, not {shown(values)}")
    known = arguments_of(owner)
    for name in values:
        if name not in known:
            raise unknown(f"{where}unknown argument", str(name), known)
    return {name: _checked(f"{where}{name}", value, known[name]) for name, value in values.items()}


def _checked(name: str, value: Any, kinds: list[str]) -> Any:
    if name == "train_freq" and not isinstance(value, list | tuple):  # or [4, "episode"]
        kinds = ["int"]
    if "any" in kinds or (value is None and "None" in kinds):
        return value
    if isinstance(value, str):
        if f"={value}" in kinds or (value == "auto" and name in AUTO):
            return value
        if "schedule" in kinds and value.startswith(("lin_", "exp_")):
            return value
    described = " or ".join(_WORDS.get(kind, kind.lstrip("=")) for kind in kinds)
    fault = f"{name} must be {described}, not {shown(value)}"
    plain = [_PLAIN[kind] for kind in kinds if kind in _PLAIN]
    if (isinstance(value, bool) and bool not in plain) or not plain:
        raise UserError(fault)
    limits = _RANGE_OF.get(name)
    expected: Any = typing.Union[tuple(plain)]  # noqa: UP007
    try:
        given: Any = expected if limits is None or str in plain else Annotated[expected, limits]
        found = TypeAdapter(given).validate_python(value)
    except ValidationError as error:
        reason = error.errors()[0]["msg"]
        reason = f": {reason[0].lower()}{reason[1:]}" if limits is not None else ""
        raise UserError(f"{fault}{reason}") from None
    if isinstance(found, float) and not math.isfinite(found) and name != "max_grad_norm":
        raise UserError(f"{name} must be finite, not {shown(value)}")
    return found


if __name__ == "__main__":
    from rl_yardstick.agents import ALGORITHMS

    names = [name for name, entry in ALGORITHMS.items() if entry.is_installed]
    signatures = {name: read_signature(name) for name in (*names, *WRAPPERS)}
    TABLE.write_text(json.dumps(signatures, indent=1) + "\n", encoding="utf-8")
