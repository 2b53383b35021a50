"""What many independent runs of one agent on one bandit came to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mdp.array_types import Bools, Floats, Ints


@dataclass(frozen=True)
class BatchResult:
    """A row for each run, a column for each pull.

    Attributes:
        seeds: of the runs, shape (n_runs,).
        arms: what was pulled, int16 of shape (n_runs, pulls).
        rewards: what it gave, float32 of shape (n_runs, pulls).
        regrets: best expected reward less that of the arm, at each pull, float64 of shape (n_runs,
            pulls).
        contexts: what the arm was chosen in, int32 of shape (n_runs, pulls); None where there is
            but one context, or contexts are vectors.
        estimates: of the mean rewards at the end, shape (n_runs, contexts, arms), nan where the
            agent has none; None for agents that keep no table.
        coefficients: of linear agents at the end, shape (n_runs, arms, features); None for others.
        moments: after how many pulls posteriors are kept.
        posteriors: of Thompson sampling, shape (n_runs, moments, contexts, arms, 2): parameters of
            the Beta distribution, or mean and standard deviation; None for others.
    """

    seeds: Ints
    arms: NDArray[np.int16]
    rewards: NDArray[np.float32]
    regrets: Floats
    contexts: NDArray[np.int32] | None = None
    estimates: Floats | None = None
    coefficients: Floats | None = None
    moments: tuple[int, ...] = ()
    posteriors: Floats | None = None

    @property
    def optimal(self) -> Bools:
        """Whether the arm was a best one, shape (n_runs, pulls)."""
        return np.asarray(self.regrets == 0.0)
