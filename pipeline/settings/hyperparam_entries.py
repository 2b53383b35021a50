"""Entries of hyperparameters in rl_zoo3's format: found in a file, and changed.

One YAML file per algorithm maps environment ids to entries. It may say which seeds these were tuned
on, see `pipeline.settings.tuned_seeds`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym

from pipeline.errors import UserError, did_you_mean, shown
from pipeline.settings.strict_yaml import read_settings_text, read_yaml
from pipeline.settings.tuned_seeds import KEY as TUNED_ON
from pipeline.settings.tuned_seeds import read_tuned_on

_FOLDER = Path(__file__).resolve().parents[2] / "hyperparams"
_ATARI_ID = re.compile(r"ALE/.*|.*NoFrameskip-v\d+")
_TOP_LEVEL_KEY = re.compile(r"^([\w./-]+):", re.MULTILINE)
_STAND_INS = ("default", "atari")


class NoEntryError(UserError):
    """A file of hyperparameters says nothing about the environment."""


def read_hyperparams(
    algo: str,
    env_id: str,
    path: Path | str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Read the entry of an environment.

    Args:
        algo: the algorithm, whose file is ``hyperparams/<algo>.yml``.
        env_id: the environment; of ``envs:Warehouse-v0`` the part after the colon counts. The entry
            ``atari`` stands in for Atari games without their own, ``default`` for all others.
        path: another file to read.
        env_kwargs: arguments of the environment. Where they make it the one that another id stands
            for, and the file has an entry for that id, it is this: for CliffWalking-v1 with
            ``is_slippery: True`` that of CliffWalkingSlippery-v1.

    Returns:
        The entry as it stands there, see `pipeline.settings.hyperparams.split`; an empty one for an
        algorithm that has no file here, such as one of the user's own.

    Raises:
        UserError: if the file cannot be read or is not of this format.
        NoEntryError: if it has no entry that fits.
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
    """The seeds that the entry of an environment was tuned on, as its file says.

    Args:
        algo: the algorithm.
        env_id: the environment.
        path: another file than the algorithm's own.

    Returns:
        Ranges of seeds, none for an entry that was chosen without; None where nobody says: in a
        file without ``tuned_on``, and for an algorithm that has no file here.

    Raises:
        UserError: as `read_hyperparams` does.
    """
    if path is None and not _path(algo, None).is_file():
        return None
    entries, tuned_on = _read(_path(algo, path))
    if tuned_on is None:
        return () if path is None else None
    return tuned_on.get(_find_entry(entries, env_id) or "", ())


def _read(path: Path) -> tuple[dict[str, Any], dict[str, tuple[range, ...]] | None]:
    """The entries of a file, and the seeds that it says they were tuned on."""
    if path.suffix == ".py":
        raise UserError(f"{path}: hyperparameters are read from YAML; Python files are not run")
    entries = read_yaml(path)
    if not (isinstance(entries, dict) and all(isinstance(key, str) for key in entries)):
        raise UserError(f"{path}: must map environment ids to hyperparameters")
    tuned_on = read_tuned_on(entries, str(path))
    return {key: entry for key, entry in entries.items() if key != TUNED_ON}, tuned_on


def _same_environment(
    entries: Mapping[str, Any], env_id: str, env_kwargs: Mapping[str, Any] | None
) -> str | None:
    """An entry's id that is registered as this environment with these arguments, and no others."""
    own = gym.registry.get(env_id.partition(":")[2] or env_id) if env_kwargs else None
    if own is None:
        return None
    given = {**own.kwargs, **(env_kwargs or {})}
    meant = own.entry_point, given, own.max_episode_steps
    named = (gym.registry[name] for name in entries if name in gym.registry)
    return next(
        (one.id for one in named if (one.entry_point, one.kwargs, one.max_episode_steps) == meant),
        None,
    )


def _find_entry(entries: Mapping[str, Any], env_id: str) -> str | None:
    env_id = env_id.partition(":")[2] or env_id
    if env_id in entries:
        return env_id
    if _ATARI_ID.fullmatch(env_id) and "atari" in entries:
        return "atari"
    return "default" if "default" in entries else None


def entry_names(algo: str, path: Path | str | None = None) -> list[str]:
    """Ids of the environments that an algorithm's file has an entry for, in its order.

    Empty where there is no such file. The stand-ins ``default`` and ``atari`` are left out.
    """
    path = _path(algo, path)
    # The keys alone, by their place in the line: parsing all files would slow listing them down.
    names = _TOP_LEVEL_KEY.findall(read_settings_text(path)) if path.is_file() else []
    return [name for name in names if name not in (*_STAND_INS, TUNED_ON)]


def _path(algo: str, path: Path | str | None) -> Path:
    return _FOLDER / f"{algo}.yml" if path is None else Path(path)


def override(entry: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The entry with ``changes`` made to it; one budget of training replaces the other."""
    kept = dict(entry)
    if not {"n_timesteps", "n_episodes"}.isdisjoint(changes):
        kept.pop("n_timesteps", None)
        kept.pop("n_episodes", None)
    return {**kept, **changes}
