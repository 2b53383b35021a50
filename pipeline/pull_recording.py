"""The pulls of a training on a bandit: a file of its run folder, and figures on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from agents.bandits.pull_log import PullLog
from pipeline.files import replacing
from pipeline.runs import PULLS_FILE

LAST_PULLS = 100


@dataclass(frozen=True)
class PullSummary:
    """Figures on the pulls of a training.

    Attributes:
        n_pulls: how many there were, over all environments.
        n_matched: how many of them a log held the arm of; all where there is no log.
        reward: mean reward of the pulls that matched; None where none did.
        regret: sum over the pulls of the best expected reward less that of the arm; None where
            nobody knows what arms are worth, as with a log.
        optimal: share of a best arm among the last pulls, likewise.
    """

    n_pulls: int
    n_matched: int
    reward: float | None
    regret: float | None
    optimal: float | None

    def as_data(self) -> dict[str, Any]:
        """The figures as JSON."""
        return asdict(self)


def summarise_pulls(pulls: Mapping[str, NDArray[Any]]) -> PullSummary:
    """Sum up arrays as `PullLog.arrays` gives them."""
    regrets, matched = pulls["regrets"], pulls["matched"]
    is_known = not bool(np.isnan(regrets).any())
    return PullSummary(
        n_pulls=int(regrets.size),
        n_matched=int(matched.sum()),
        reward=float(pulls["rewards"][matched].mean(dtype=np.float64)) if matched.any() else None,
        regret=float(regrets.sum()) if is_known else None,
        optimal=float(pulls["optimal"][:, -LAST_PULLS:].mean()) if is_known else None,
    )


class PullRecorder(PullLog):
    """Writes ``pulls.npz`` at the end of training; see `PullLog.arrays` for what is in it.

    Args:
        folder: where to.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_training_end(self) -> None:
        self.write()

    def write(self) -> None:
        """Write the pulls so far."""
        with replacing(self.folder / PULLS_FILE) as file:
            np.savez(file, allow_pickle=False, **self.arrays())


def are_bandits(env: VecEnv) -> bool:
    """Whether the environments have arms whose pulls can be recorded."""
    return env.has_attr("n_arms")
