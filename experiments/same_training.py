"""Whether two runs are the same training: weights and tables, episodes and evaluations."""

from __future__ import annotations

import numpy as np

from experiments.run_figures import read_episodes, read_evaluations
from pipeline.file_digests import DamagedFileError
from pipeline.run_folder import Run
from safe_files.archives import read_members
from safe_files.files import UnsafeFileError


def difference(run: Run, other: Run) -> str:
    """In what two finished runs differ; empty where they are the same to the last bit.

    Raises:
        DamagedFileError: if a file of one of them is missing or damaged.
    """
    if _tensors(run) != _tensors(other):
        return "the agent"
    one, another = read_episodes(run), read_episodes(other)
    if not (_same(one.steps, another.steps) and _same(one.returns, another.returns)):
        return "the episodes"
    if not all(map(_same, read_evaluations(run), read_evaluations(other))):
        return "the evaluations"
    return ""


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return one.tobytes() == other.tobytes()


def _tensors(run: Run) -> dict[str, bytes]:
    """What the agent at the end has learnt, as its zip holds it."""
    try:
        members = read_members(run.files.read(run.model_path))
    except UnsafeFileError as error:
        raise DamagedFileError(run.model_path, str(error)) from error
    return {name: content for name, content in members.items() if name.endswith(".pth")}
