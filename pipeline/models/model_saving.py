"""Writing an agent, and what belongs to it, whole or not at all."""

from __future__ import annotations

import pickle
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

from pipeline.files import lasting
from pipeline.finite_numbers import check_model


def save_model(model: BaseAlgorithm, path: Path) -> None:
    """Write the agent to ``path``, whole or not at all.

    Raises:
        NotFiniteError: if there are nan or infinity in what it has learnt: what is there stays.
    """
    check_model(model)
    with lasting(path) as file:
        model.save(file)


def save_normalization(model: BaseAlgorithm, path: Path) -> None:
    """Write the running statistics of VecNormalize, where the agent trains under one."""
    normalization = model.get_vec_normalize_env()
    if normalization is not None:
        with lasting(path) as file:
            pickle.dump(normalization, file)  # as its own `save`, which takes paths alone


def save_replay_buffer(model: BaseAlgorithm, path: Path) -> None:
    """Write the replay buffer, where the agent has one."""
    if getattr(model, "replay_buffer", None) is not None:
        with lasting(path) as file:
            model.save_replay_buffer(file)  # type: ignore[attr-defined]
