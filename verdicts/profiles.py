"""Performance profiles: how an agent's scores are spread over environments and seeds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from verdicts.bootstrap import (
    N_RESAMPLES,
    as_columns,
    interval_tail,
    percentile_interval,
    resample_counts,
)
from verdicts.learning_curves import Band


def performance_profile(
    scores: ArrayLike,
    thresholds: ArrayLike,
    *,
    seed: int,
    confidence: float = 0.95,
    n_resamples: int = N_RESAMPLES,
) -> Band:
    """The share of runs that score higher than each threshold, averaged over environments.

    Args:
        scores: shape (n_seeds,), or (n_seeds, n_envs) on a scale that the environments share. What
            is not finite counts as missing; where an environment has nothing else the share is NaN.
        thresholds: shape (n_thresholds,).
        seed: of the resampling, of seeds within each environment.
        confidence: of the intervals, which hold threshold by threshold.
        n_resamples: how many resamples they come from.

    Returns:
        The shares with their intervals, each of shape (n_thresholds,). Where all runs of every
        environment lie on the same side of a threshold the interval is the point.

    Raises:
        ValueError: for arguments out of range or of another shape.

    Source: Agarwal et al. (2021), section 4.2, "run-score distributions". The intervals are widened
    for few seeds, see ``interval_tail``.
    """
    columns, marks = as_columns(scores), np.asarray(thresholds, dtype=np.float64)
    strata = [column[np.isfinite(column)] for column in columns.T]
    if any(len(stratum) == 0 for stratum in strata):
        nothing = np.full(marks.shape, np.nan)
        return Band(nothing, nothing, nothing)
    above = [(stratum[:, None] > marks).astype(np.float64) for stratum in strata]
    rng = np.random.default_rng(seed)
    resampled = np.zeros((n_resamples, len(marks)))
    for rows in above:
        resampled += resample_counts(len(rows), n_resamples, rng) @ rows / len(rows)
    tail = interval_tail(strata, confidence)
    low, high = percentile_interval(resampled / len(above), tail)
    return Band(np.mean([rows.mean(axis=0) for rows in above], axis=0), low, high)
