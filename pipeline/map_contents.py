"""Maps by their contents: what a run remembers of a map must not depend on where its file lay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

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
    named = [key for key in _ENV_KWARGS if _names_a_file(settings.get(key))]
    if not (named and _is_grid_world(env_id)):
        return dict(settings)
    try:
        read = {
            key: {**settings[key], "desc": list(read_rows(settings[key]["desc"]))} for key in named
        }
    except ValueError as error:
        raise UserError(f"{env_id}: {one_line(error)}") from error
    return {**settings, **read}


def _names_a_file(env_kwargs: object) -> bool:
    return isinstance(env_kwargs, dict) and isinstance(env_kwargs.get("desc"), str)


def _is_grid_world(env_id: str) -> bool:
    entry_point = gym.spec(env_id.rpartition(":")[2]).entry_point
    creator: object = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return isinstance(creator, type) and issubclass(creator, GridWorld)
