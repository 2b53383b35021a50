"""What Monitor remembers of all episodes: left out of states, and read back from its file.

A compiled training has a million episodes in a few seconds. To save them with each state would
take longer than all else together.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from agents.compiled.episodes import n_whole_returns
from pipeline.resuming.log_positions import MONITOR_FILES, Position
from safe_files.files import NO_LIMIT, opened
from snapshots.filling import NotRestorableError

RETURNS, LENGTHS, TIMES = "episode_returns", "episode_lengths", "episode_times"
_HEAD_LINES = 2

# By the name of a Monitor's file, the names of its lists.
Lists = dict[str, list[str]]


def lists_in_files(env: VecEnv, folder: Path, positions: Mapping[str, Position]) -> Lists:
    """The lists of Monitors that their files in a run folder hold to the last bit.

    Returns are rounded there, which whole numbers outlast. Times are rounded too; but they are
    those of this machine and this day in any case.

    Args:
        env: the environments.
        folder: the run folder.
        positions: where its files are.
    """
    found = {}
    for name, monitor in _monitors(env, folder).items():
        n_rows = positions[name][2] - _HEAD_LINES
        if all(len(getattr(monitor, held)) == n_rows for held in (RETURNS, LENGTHS, TIMES)):
            found[name] = [*([RETURNS] if _are_whole(monitor) else []), LENGTHS, TIMES]
    return found


def _are_whole(monitor: Monitor[Any, Any]) -> bool:
    returns = np.array(monitor.episode_returns[n_whole_returns(monitor) :], float)
    return bool((returns == np.rint(returns)).all())


def held_in(env: VecEnv, folder: Path, lists: Lists) -> list[Any]:
    """Those lists themselves."""
    monitors = _monitors(env, folder)
    return [getattr(monitors[name], held) for name, names in lists.items() for held in names]


def read_back(env: VecEnv, folder: Path, lists: Mapping[str, list[str]]) -> None:
    """Fill those lists from the files.

    Raises:
        NotRestorableError: if there is no such Monitor.
    """
    monitors = _monitors(env, folder)
    for name, names in lists.items():
        if name not in monitors:
            raise NotRestorableError(f"the Monitor of {name} is missing")
        columns = _columns(folder / name)
        for held in names:
            getattr(monitors[name], held)[:] = columns[held]


def _monitors(env: VecEnv, folder: Path) -> dict[str, Monitor[Any, Any]]:
    """By the names of their files, the Monitors that write into a folder."""
    found = {}
    for layer in _layers(env):
        if isinstance(layer, Monitor) and layer.results_writer is not None:
            path = Path(layer.results_writer.file_handler.name)
            if path.parent == folder.resolve() and path.match(MONITOR_FILES):
                found[path.name] = layer
    return found


def _layers(env: VecEnv) -> Iterator[gym.Env[Any, Any]]:
    """The wrappers of all environments that are in this process."""
    for layer in getattr(env.unwrapped, "envs", []):
        while isinstance(layer, gym.Wrapper):
            yield layer
            layer = layer.env  # noqa: PLW2901  # one after the other


def _columns(path: Path) -> dict[str, list[Any]]:
    with opened(path, NO_LIMIT) as content:
        file = io.TextIOWrapper(content, encoding="utf-8", newline="")
        for _ in range(_HEAD_LINES):
            next(file)
        rows = [row[:3] for row in csv.reader(file)]
    return {
        RETURNS: [float(row[0]) for row in rows],
        LENGTHS: [int(row[1]) for row in rows],
        TIMES: [float(row[2]) for row in rows],
    }
