"""The pulls of a training on a bandit, as a file of its run folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from agents.bandits.records import PullLog
from pipeline.files import replacing

PULLS_FILE = "pulls.npz"


class PullRecorder(PullLog):
    """Writes ``pulls.npz`` at the end of training; see `PullLog.arrays` for what is in it.

    Args:
        folder: where to.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_training_end(self) -> None:
        with replacing(self.folder / PULLS_FILE) as draft, draft.open("wb") as file:
            np.savez(file, allow_pickle=False, **self.arrays())


def are_bandits(env: VecEnv) -> bool:
    """Whether the environments have arms whose pulls can be told of."""
    return env.has_attr("n_arms")
