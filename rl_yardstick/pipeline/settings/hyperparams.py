"""Reads and checks hyperparameters in rl_zoo3's format; runs no code in a file.

One YAML file per algorithm maps environment ids to entries. An entry holds arguments of the
algorithm's constructor, and the special keys that `Hyperparams` lists. A file may also list, under
``tuned_on``, the seeds on which its entries were tuned.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_type_hints

from rl_yardstick.pipeline.errors import UserError, did_you_mean, shown
from rl_yardstick.pipeline.settings.values import (
    check_arguments,
    check_range,
    coerce,
    contains_name,
)
from rl_yardstick.pipeline.settings.yaml import read_yaml, settings_bytes

# Constructor arguments that a flag or another key sets, and its name.
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


def _keywords(**kinds: Any) -> Mapping[str, inspect.Parameter]:
    kind = inspect.Parameter.KEYWORD_ONLY
    return {name: inspect.Parameter(name, kind, annotation=kinds[name]) for name in kinds}


_KEYWORDS: Mapping[str, Mapping[str, inspect.Parameter]] = {
    "normalize": _keywords(
        **dict.fromkeys(("training", "norm_obs", "norm_reward"), bool),
        **dict.fromkeys(("clip_obs", "clip_reward", "gamma", "epsilon"), float),
        norm_obs_keys=list[str] | None,
    ),
    "monitor_kwargs": _keywords(
        allow_early_resets=bool,
        **dict.fromkeys(("reset_keywords", "info_keywords"), tuple[str, ...]),
        override_existing=bool,
    ),
}


@dataclass(frozen=True)
class ComponentSpec:
    """A wrapper or callback of an entry."""

    name: str  # the dotted name of its class
    kwargs: dict[str, Any] = field(default_factory=dict)  # arguments of its constructor


@dataclass(frozen=True)
class Hyperparams:
    """One entry, the special keys apart from the algorithm's arguments."""

    # training steps; None if counted in episodes or not given
    n_timesteps: int | None = None
    n_episodes: int | None = None  # training episodes; never set together with ``n_timesteps``
    n_envs: int = 1  # parallel training environments
    # arguments of VecNormalize, including the algorithm's ``gamma``; None without it
    normalize: dict[str, Any] | None = None
    # wrappers of every environment, innermost first
    env_wrapper: tuple[ComponentSpec, ...] = ()
    # further outer wrappers of the training environments
    train_env_wrapper: tuple[ComponentSpec, ...] = ()
    vec_env_wrapper: tuple[ComponentSpec, ...] = ()  # wrappers of the vectorised environment
    callback: tuple[ComponentSpec, ...] = ()  # callbacks of the training
    env_kwargs: dict[str, Any] = field(default_factory=dict)  # arguments of every environment
    # further arguments of the training environments only
    train_env_kwargs: dict[str, Any] = field(default_factory=dict)
    # further arguments of the evaluation environments only
    eval_env_kwargs: dict[str, Any] = field(default_factory=dict)
    frame_stack: int | None = None  # number of stacked observations, or None
    monitor_kwargs: dict[str, Any] = field(default_factory=dict)  # arguments of Monitor
    # action noise, for algorithms with an argument ``action_noise``
    noise_type: Literal["normal", "ornstein-uhlenbeck"] | None = None
    # its standard deviation. Without ``noise_type``, the key is an ordinary argument of the
    # algorithm.
    noise_std: float | None = None
    flush_denormal: bool = False  # the processor replaces numbers below 1e-38 by zero
    # all other keys: arguments of the algorithm's constructor, not checked yet
    algorithm: dict[str, Any] = field(default_factory=dict)


SPECIAL_KEYS = tuple(key.name for key in fields(Hyperparams) if key.name != "algorithm")


_hints = cache(get_type_hints)  # evaluating them takes longer than reading an entry


def split(entry: Mapping[str, Any], where: str = "hyperparameters") -> Hyperparams:
    """Separate an entry's special keys (unless null) from the algorithm's arguments; check them."""
    # Without noise_type, noise_std is an argument of some agents.
    is_action_noise = entry.get("noise_type") is not None
    special_keys = [key for key in SPECIAL_KEYS if key != "noise_std" or is_action_noise]
    algorithm = {key: value for key, value in entry.items() if key not in special_keys}
    special = {key: value for key in special_keys if (value := entry.get(key)) is not None}
    if isinstance(special.get("normalize"), bool):
        special["normalize"] = {} if special["normalize"] else None
    for key, value in special.items():
        if key in _WRAPPERS:
            special[key] = component_specs(value, f"{where}: {key}")
        else:
            special[key] = coerce(value, _hints(Hyperparams)[key], f"{where}: {key}")
        check_range(key, special[key], where)
        if isinstance(special[key], dict) and contains_name(special[key]):
            raise UserError(
                f"{where}: {key} takes plain values, not names: put quotes around texts"
            )
        if key in _KEYWORDS and special[key] is not None:
            special[key] = check_arguments(special[key], _KEYWORDS[key], f"{where}: {key}")
    if "n_timesteps" in special and "n_episodes" in special:
        raise UserError(f"{where}: give n_timesteps or n_episodes, not both")
    if "noise_type" in special and "noise_std" not in special:
        raise UserError(f"{where}: noise_type needs noise_std, the standard deviation of the noise")
    if special.get("normalize") is not None and "gamma" in algorithm:
        # As in rl_zoo3, rewards are normalised with the agent's discount.
        gamma = coerce(algorithm["gamma"], float, f"{where}: gamma")
        special["normalize"].setdefault("gamma", gamma)
    return Hyperparams(**special, algorithm=algorithm)


def component_specs(spec: Any, where: str) -> tuple[ComponentSpec, ...]:
    """Read wrappers or callbacks in rl_zoo3's forms."""
    found = []
    for item in spec if isinstance(spec, list | tuple) else [] if spec is None else [spec]:
        if isinstance(item, ComponentSpec):
            found.append(item)
            continue
        named = [*item.items()] if isinstance(item, dict) else [(item, None)]
        name, kwargs = named[0] if len(named) == 1 else (None, None)
        kwargs = {} if kwargs is None else kwargs
        is_right = isinstance(kwargs, dict) and all(isinstance(key, str) for key in kwargs)
        if not (isinstance(name, str) and is_right):
            raise UserError(
                f"{where} must be the dotted name of a class, or that name with its arguments "
                f"indented below it, or a list of these; not {shown(item)}"
            )
        found.append(ComponentSpec(name, kwargs))
    return tuple(found)


def check_algorithm_kwargs(
    kwargs: Mapping[str, Any], parameters: Mapping[str, inspect.Parameter], where: str
) -> dict[str, Any]:
    """Check constructor arguments by name, type and range; returns values of `coerce`."""
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


_FOLDER = Path(__file__).resolve().parents[2] / "hyperparams"
_ATARI_ID = re.compile(r"ALE/.*|.*NoFrameskip-v\d+")
_TOP_LEVEL_KEY = re.compile(r"^([\w./-]+):", re.MULTILINE)
_STAND_INS = ("default", "atari")
TUNED_ON = "tuned_on"


class NoEntryError(UserError):
    """A file of hyperparameters has no entry for the environment."""


def read_hyperparams(
    algo: str,
    env_id: str,
    path: Path | str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Read the entry of an environment from ``hyperparams/<algo>.yml``, or from another file.

    Atari games without an entry use the entry ``atari``, all others ``default``. An algorithm
    without a file, such as the user's own, has an empty entry. If ``env_kwargs`` make the
    environment equal to another id, the entry of that id is used: for CliffWalking-v1 with
    ``is_slippery: True``, the entry of CliffWalkingSlippery-v1.
    """
    if path is None and not _path(algo, None).is_file():
        return {}
    path = _path(algo, path)
    entries, _ = _read(path)
    key = _same_environment(entries, env_id, env_kwargs) or _find_entry(entries, env_id)
    if key is None:
        hint = did_you_mean(env_id, [name for name in entries if name not in _STAND_INS], n=3)
        raise NoEntryError(
            f"{path}: no entry for {shown(env_id)}{' (' + hint + ')' if hint else ''}; "
            "give hyperparameters with -params, or another file with --conf-file"
        )
    entry = entries[key]
    if not (isinstance(entry, dict) and all(isinstance(name, str) for name in entry)):
        raise UserError(f"{path}: the entry {key} must map names to values")
    return entry


def seeds_tuned_on(
    algo: str, env_id: str, path: Path | str | None = None
) -> tuple[range, ...] | None:
    """The seeds on which an environment's entry was tuned; None if its file does not say."""
    if path is None and not _path(algo, None).is_file():
        return None
    entries, tuned_on = _read(_path(algo, path))
    if tuned_on is None:
        return () if path is None else None
    return tuned_on.get(_find_entry(entries, env_id) or "", ())


def _read(path: Path) -> tuple[dict[str, Any], dict[str, tuple[range, ...]] | None]:
    """Read the entries of a file, and the seeds of their tuning."""
    if path.suffix == ".py":
        raise UserError(f"{path}: hyperparameters are read from YAML; Python files are not run")
    entries = read_yaml(path)
    if not (isinstance(entries, dict) and all(isinstance(key, str) for key in entries)):
        raise UserError(f"{path}: must map environment ids to hyperparameters")
    tuned_on = _read_tuned_on(entries, f"{path}: {TUNED_ON}") if TUNED_ON in entries else None
    return {key: entry for key, entry in entries.items() if key != TUNED_ON}, tuned_on


def _same_environment(
    entries: Mapping[str, Any], env_id: str, env_kwargs: Mapping[str, Any] | None
) -> str | None:
    """The id of an entry that is registered as this environment with the same arguments."""
    if not env_kwargs:
        return None
    import gymnasium as gym

    own = gym.registry.get(env_id.partition(":")[2] or env_id)
    if own is None:
        return None
    given = {**own.kwargs, **env_kwargs}
    meant = own.entry_point, given, own.max_episode_steps
    named = (gym.registry[name] for name in entries if name in gym.registry)
    return next(
        (one.id for one in named if (one.entry_point, one.kwargs, one.max_episode_steps) == meant),
        None,
    )


def _find_entry(entries: Mapping[str, Any], env_id: str) -> str | None:
    env_id = env_id.partition(":")[2] or env_id
    names = (env_id, "atari" if _ATARI_ID.fullmatch(env_id) else "default", "default")
    return next((name for name in names if name in entries), None)


def entry_names(algo: str, path: Path | str | None = None) -> list[str]:
    """Ids of the environments with an entry in an algorithm's file, in the file's order."""
    path = _path(algo, path)
    # Finds keys by their position in the line, because parsing all files would be slow.
    text = settings_bytes(path).decode() if path.is_file() else ""
    return [name for name in _TOP_LEVEL_KEY.findall(text) if name not in (*_STAND_INS, TUNED_ON)]


def _path(algo: str, path: Path | str | None) -> Path:
    return _FOLDER / f"{algo}.yml" if path is None else Path(path)


def override(entry: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Change an entry; a new training budget replaces the old one, also in another unit."""
    budgets = {"n_timesteps", "n_episodes"}
    gone = set() if budgets.isdisjoint(changes) else budgets
    return {**{key: value for key, value in entry.items() if key not in gone}, **changes}


def _read_tuned_on(entries: Mapping[str, Any], where: str) -> dict[str, tuple[range, ...]]:
    """Read the tuning seeds of each entry: ``{first: 0, count: 10}``, or a list of these."""
    said = entries[TUNED_ON]
    if not isinstance(said, dict):
        raise UserError(f"{where} must map entries to seeds, not be {shown(said)}")
    missing = next((name for name in said if name not in entries or name == TUNED_ON), None)
    if missing is not None:
        raise UserError(f"{where} names {shown(missing)}, which has no entry there")
    return {
        name: tuple(
            _seeds(item, f"{where}: {name}")
            for item in (seeds if isinstance(seeds, list) else [seeds])
        )
        for name, seeds in said.items()
    }


def _seeds(given: Any, where: str) -> range:
    numbers = list(given.values()) if isinstance(given, dict) else []
    is_whole = all(isinstance(n, int) and not isinstance(n, bool) and n >= 0 for n in numbers)
    if not (isinstance(given, dict) and {*given} == {"first", "count"} and is_whole):
        raise UserError(f"{where} must be like {{first: 0, count: 10}}, not {shown(given)}")
    return range(given["first"], given["first"] + given["count"])
