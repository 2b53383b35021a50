"""The generators that libraries draw from without being told: Python's, NumPy's and PyTorch's."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch as th


def generator_states() -> dict[str, Any]:
    """Where they are."""
    cuda = (
        [state.numpy() for state in th.cuda.get_rng_state_all()] if th.cuda.is_available() else []
    )
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002  # libraries draw from it
        "torch": th.get_rng_state().numpy(),
        "cuda": cuda,
    }


def set_generators(states: dict[str, Any]) -> None:
    """Put them where they were."""
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])  # noqa: NPY002
    th.set_rng_state(th.from_numpy(states["torch"].copy()))
    if states["cuda"]:
        th.cuda.set_rng_state_all([th.from_numpy(state.copy()) for state in states["cuda"]])
