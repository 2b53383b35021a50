"""What a run remembers of files that arguments of environments name: wherever it is played.

Of a map that is its rows. A log of pulls may be long: of it, the full path is kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from envs.bandits.replay import ReplayBandit
from envs.grid import GridWorld
from envs.grid_map import read_rows
from pipeline.errors import UserError, one_line

_ENV_KWARGS = ("env_kwargs", "train_env_kwargs", "eval_env_kwargs")


def with_maps_read(env_id: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The hyperparameters with the rows of each map in place of the path to its file.

    Args:
        env_id: a registered environment; others than grid worlds are left as they are.
        settings: an entry of hyperparameters.

    Raises:
        UserError: if a map's file cannot be read.
    """
    named = _naming(settings, "desc")
    if not (named and _is_kind_of(GridWorld, env_id)):
        return dict(settings)
    try:
        read = {
            key: {**settings[key], "desc": list(read_rows(settings[key]["desc"]))} for key in named
        }
    except ValueError as error:
        raise UserError(f"{env_id}: {one_line(error)}") from error
    return {**settings, **read}


def with_logs_located(env_id: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The hyperparameters with the full path to each log of pulls.

    Args:
        env_id: a registered environment; others than ReplayBandit are left as they are.
        settings: an entry of hyperparameters.
    """
    named = _naming(settings, "log")
    if not (named and _is_kind_of(ReplayBandit, env_id)):
        return dict(settings)
    paths = {key: str(Path(settings[key]["log"]).absolute()) for key in named}
    return {**settings, **{key: {**settings[key], "log": path} for key, path in paths.items()}}


def _naming(settings: Mapping[str, Any], argument: str) -> list[str]:
    """The keys of the settings that give the environment a text as that argument."""
    given = {key: settings.get(key) for key in _ENV_KWARGS}
    return [
        key
        for key, env_kwargs in given.items()
        if isinstance(env_kwargs, dict) and isinstance(env_kwargs.get(argument), str)
    ]


def _is_kind_of(kind: type[gym.Env[Any, Any]], env_id: str) -> bool:
    entry_point = gym.spec(env_id.rpartition(":")[2]).entry_point
    creator: object = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return isinstance(creator, type) and issubclass(creator, kind)
