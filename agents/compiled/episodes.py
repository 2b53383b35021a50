"""What Monitor and the logger learn of many episodes at once."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor

from agents.compiled.row_text import whole_rows
from mdp.array_types import Bools, Floats, Ints

DECIMALS = 6
# Of Monitor, besides its own attributes: to look at a million numbers later would take long.
_N_WHOLE = "n_whole_returns"
MOST_BEGINNINGS = 10_000


@dataclass(frozen=True)
class Episodes:
    """Episodes that ended in a block, in the order in which they did.

    Attributes:
        envs: which environment each ran in, shape (n_episodes,).
        steps: at which step of the block it ended, shape (n_episodes,).
        returns: sum of its rewards, shape (n_episodes,).
        lengths: number of its steps, shape (n_episodes,).
        successes: whether it was a success, shape (n_episodes,).
    """

    envs: Ints
    steps: Ints
    returns: Floats
    lengths: Ints
    successes: Bools

    @classmethod
    def of(cls, log: NDArray[np.void]) -> Episodes:
        """The episodes of records of type `EPISODE`, shape (n_episodes,)."""
        return cls(log["env"], log["step"], log["episode_return"], log["length"], log["success"])

    def rounded_returns(self) -> Floats:
        """Returns as Monitor tells them, shape (n_episodes,)."""
        if (self.returns == np.rint(self.returns)).all():
            return self.returns
        return np.array([_rounded(total) for total in self.returns.tolist()])

    def infos(self, chosen: slice, times: list[float]) -> list[dict[str, Any]]:
        """What Monitor would have put into ``info["episode"]`` for some of the episodes."""
        return [
            {"r": _rounded(total), "l": length, "t": times[env]}
            for env, total, length in zip(
                self.envs[chosen].tolist(),
                self.returns[chosen].tolist(),
                self.lengths[chosen].tolist(),
                strict=True,
            )
        ]


def record_in_monitors(monitors: list[Monitor | None], episodes: Episodes) -> list[float]:
    """Do for a block of episodes what each Monitor does at the end of each.

    All of them get the time of the end of the block.

    Returns:
        That time for each environment, in seconds since its Monitor was made.
    """
    times = []
    for i, monitor in enumerate(monitors):
        if monitor is None:
            times.append(0.0)
            continue
        elapsed = time.time() - monitor.t_start
        times.append(round(elapsed, DECIMALS))
        chosen = slice(None) if len(monitors) == 1 else episodes.envs == i
        returns, lengths = episodes.returns[chosen], episodes.lengths[chosen]
        _note_whole(monitor, returns)
        monitor.episode_returns += returns.tolist()
        monitor.episode_lengths += lengths.tolist()
        monitor.episode_times += [elapsed] * len(returns)
        if monitor.results_writer is not None and len(returns):
            _write_rows(monitor.results_writer.file_handler, returns, lengths, times[i])
    return times


def n_whole_returns(monitor: Monitor) -> int:
    """How many returns, from the first one on, Monitor is known to hold that are whole numbers."""
    return int(vars(monitor).get(_N_WHOLE, 0))


def _note_whole(monitor: Monitor, returns: Floats) -> None:
    n_before = len(monitor.episode_returns)
    if n_whole_returns(monitor) == n_before and (returns == np.rint(returns)).all():
        vars(monitor)[_N_WHOLE] = n_before + len(returns)


def _write_rows(file: Any, returns: Floats, lengths: Ints, seconds: float) -> None:
    """Append rows as csv.DictWriter would."""
    end = f"{seconds}\r\n"
    text = whole_rows(np.ascontiguousarray(returns), np.ascontiguousarray(lengths), end)
    if text is None:
        # As one number, which is found sooner than a pair of them.
        rows = (returns + 1j * lengths).tolist()
        text = end.join(map(_beginnings.__getitem__, rows)) + end
    file.write(text)
    file.flush()


class _Beginnings(dict[complex, str]):
    """How the row of an episode begins; equal episodes are common where rewards are whole.

    By the return of an episode, and its length as the imaginary part.
    """

    def __missing__(self, key: complex) -> str:
        if len(self) >= MOST_BEGINNINGS:
            self.clear()
        self[key] = beginning = f"{_rounded(key.real)},{int(key.imag)},"
        return beginning


_beginnings = _Beginnings()


@lru_cache(maxsize=10_000)
def _rounded(episode_return: float) -> float:
    return round(episode_return, DECIMALS)
