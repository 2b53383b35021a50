"""The episodes of a compiled block, and their rows in Monitor's files."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor

from rl_yardstick.mdp.transition_model import Bools, Floats, Ints

# To which Monitor rounds returns and times.
DECIMALS = 6


@dataclass(frozen=True)
class Episodes:
    """Episodes that ended in a block, in order of time."""

    envs: Ints  # which environment each ran in, shape (n_episodes,)
    steps: Ints  # at which step of the block it ended, shape (n_episodes,)
    returns: Floats  # sum of its rewards, shape (n_episodes,)
    lengths: Ints  # number of its steps, shape (n_episodes,)
    successes: Bools  # whether it was a success, shape (n_episodes,)

    @classmethod
    def of(cls, log: NDArray[np.void]) -> Episodes:
        """The episodes of records of type `EPISODE`, shape (n_episodes,)."""
        return cls(log["env"], log["step"], log["episode_return"], log["length"], log["success"])

    def infos(self, chosen: slice, times: list[float]) -> list[dict[str, Any]]:
        """What Monitor would have put into ``info["episode"]`` for some of the episodes."""
        return [
            {"r": round(total, DECIMALS), "l": length, "t": times[env]}
            for env, total, length in zip(
                self.envs[chosen].tolist(),
                self.returns[chosen].tolist(),
                self.lengths[chosen].tolist(),
                strict=True,
            )
        ]


def record_in_monitors(
    monitors: list[Monitor | None], episodes: Episodes, n_steps: int
) -> list[float]:
    """Record a block of episodes in the Monitors, as each does at the end of an episode.

    Returns the time at the end of the block, which all get, in seconds since each was made.
    """
    times = []
    for i, monitor in enumerate(monitors):
        if monitor is None:
            times.append(0.0)
            continue
        monitor.total_steps += n_steps
        elapsed = time.time() - monitor.t_start
        times.append(round(elapsed, DECIMALS))
        chosen = slice(None) if len(monitors) == 1 else episodes.envs == i
        returns, lengths = episodes.returns[chosen].tolist(), episodes.lengths[chosen].tolist()
        monitor.episode_returns += returns
        monitor.episode_lengths += lengths
        monitor.episode_times += [elapsed] * len(returns)
        if monitor.results_writer is not None and returns:
            end = f"{times[i]}\r\n"
            file: Any = monitor.results_writer.file_handler
            file.write(end.join(map(_row, returns, lengths)) + end)
            file.flush()
    return times


@lru_cache(maxsize=10_000)  # equal episodes are common, and formatting is slow
def _row(episode_return: float, length: int) -> str:
    return f"{round(episode_return, DECIMALS)},{length},"
