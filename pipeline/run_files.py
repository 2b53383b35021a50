"""The names of the files in a run folder, which are rl_zoo3's where it has them too."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from pipeline.file_digests import RECORD, STATE_FOLDER
from pipeline.files import portable_name

PULLS_FILE = "pulls.npz"


def environment_name(env_id: str) -> str:
    """The environment's id as a file name: no module before it, and no slash in it."""
    return portable_name(env_id.rpartition(":")[2].replace("/", "-"))


@dataclass(frozen=True)
class RunFiles:
    """The files of a run.

    Attributes:
        path: the folder.
        env_name: the environment's name in file names.
    """

    path: Path
    env_name: str

    @property
    def params_path(self) -> Path:
        """The folder of the run's settings and normalisation statistics."""
        return self.path / self.env_name

    @property
    def model_path(self) -> Path:
        """The agent at the end of training."""
        return self.path / f"{self.env_name}.zip"

    @property
    def best_model_path(self) -> Path:
        """The agent that evaluated best."""
        return self.path / "best_model.zip"

    def checkpoint_path(self, n_steps: int) -> Path:
        """The agent after ``n_steps`` steps."""
        return self.path / f"rl_model_{n_steps}_steps.zip"

    def checkpoints(self) -> list[Path]:
        """The checkpoints that there are, by rising number of steps."""
        steps = (
            re.fullmatch(r"rl_model_(\d+)_steps\.zip", path.name) for path in self.path.iterdir()
        )
        return [self.checkpoint_path(n) for n in sorted(int(match[1]) for match in steps if match)]

    @property
    def evaluations_path(self) -> Path:
        """The evaluations during training."""
        return self.path / "evaluations.npz"

    @property
    def vecnormalize_path(self) -> Path:
        """The running statistics of VecNormalize."""
        return self.params_path / "vecnormalize.pkl"

    @property
    def state_path(self) -> Path:
        """The folder of the states that a training under way goes on from."""
        return self.path / STATE_FOLDER

    @property
    def info_path(self) -> Path:
        """What the run was asked for and what came out."""
        return self.path / RECORD

    @property
    def curve_path(self) -> Path:
        """The picture of the learning curve."""
        return self.path / "learning_curve.png"

    @property
    def pulls_picture_path(self) -> Path:
        """The picture of the pulls, on bandits."""
        return self.path / "pulls.png"

    @property
    def value_maps_path(self) -> Path:
        """The policy and its values during training, on grid worlds."""
        return self.path / "value_maps.npz"

    @property
    def value_map_path(self) -> Path:
        """The picture of the policy at the end of training, on grid worlds."""
        return self.path / "value_map.png"


# States in a folder: the newest two, so that one is whole.
GENERATIONS = 2


def state_file(folder: Path, number: int) -> Path:
    """Where the state of that number lies, in place of the one before the last."""
    return folder / f"{'odd' if number % GENERATIONS else 'even'}.state"


def state_files(folder: Path) -> list[Path]:
    """Where states may lie."""
    return [state_file(folder, number) for number in range(GENERATIONS)]


def has_state(folder: Path) -> bool:
    """Whether there is a file that may be a state."""
    return any(path.is_file() for path in state_files(folder))


def remove_states(folder: Path) -> None:
    """Remove all states."""
    shutil.rmtree(folder, ignore_errors=True)
