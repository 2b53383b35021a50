"""Time limits that depend on the environment's arguments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from envs.bandits.bandit import Bandit
from envs.grid import GridWorld


def limit_by_shortest_path(
    env: gym.Env[Any, Any], multiple: int, instead_of: int
) -> gym.Env[Any, Any]:
    """Limit the episodes of a grid world to a multiple of its shortest path.

    Args:
        env: a grid world as `gymnasium.make` returns it.
        multiple: the limit in shortest paths.
        instead_of: the limit that this one takes the place of. One that differs, or none, is the
            wish of whoever made the environment, and stays.

    Returns:
        The environment under the limit.
    """
    grid_world = env.unwrapped
    if not isinstance(env, gym.wrappers.TimeLimit) or env.spec is None:
        return env
    if env.spec.max_episode_steps != instead_of or not isinstance(grid_world, GridWorld):
        return env
    return gym.wrappers.TimeLimit(env.env, multiple * grid_world.shortest_path_length)


def limit_by_pulls(env: gym.Env[Any, Any], instead_of: int) -> gym.Env[Any, Any]:
    """Limit the episodes of a bandit to its `pulls`.

    Args:
        env: a bandit as `gymnasium.make` returns it.
        instead_of: see `limit_by_shortest_path`.

    Returns:
        The environment under the limit.
    """
    bandit = env.unwrapped
    if not isinstance(env, gym.wrappers.TimeLimit) or env.spec is None:
        return env
    if env.spec.max_episode_steps != instead_of or not isinstance(bandit, Bandit):
        return env
    return gym.wrappers.TimeLimit(env.env, bandit.pulls)
