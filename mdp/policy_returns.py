"""What an episode comes to, in the mean and around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mdp.array_types import Floats


@dataclass(frozen=True)
class PolicyReturn:
    """Mean and variance of one episode, from the distribution of starting states.

    Attributes:
        expected_return: the mean of the (discounted) sum of rewards.
        return_variance: its variance.
        expected_length: the mean number of steps; infinite where episodes may never end.
        length_variance: its variance; NaN where the mean is infinite.
        success_rate: the probability that the episode succeeds; None where success was not defined.
    """

    expected_return: float
    return_variance: float
    expected_length: float
    length_variance: float
    success_rate: float | None

    @property
    def success_variance(self) -> float | None:
        """The variance of one episode's success, counted as 0 or 1."""
        return None if self.success_rate is None else self.success_rate * (1 - self.success_rate)


def over_starts(initial: Floats, moments: Floats, *, with_success: bool) -> PolicyReturn:
    """Average over the starting states; their differences add to the variances.

    Args:
        initial: probabilities of the starting states, shape (n,).
        moments: as `mdp.moments.moments_under_limit` gives them, shape (n, 5).
        with_success: whether success was defined.
    """
    start = initial > 0
    chance, moments = initial[start], moments[start]
    mean = chance @ moments
    return PolicyReturn(
        expected_return=float(mean[0]),
        return_variance=float(mean[1] + chance @ (moments[:, 0] - mean[0]) ** 2),
        expected_length=float(mean[2]),
        length_variance=float(mean[3] + chance @ (moments[:, 2] - mean[2]) ** 2)
        if np.isfinite(mean[2])
        else float("nan"),
        success_rate=float(mean[4]) if with_success else None,
    )
