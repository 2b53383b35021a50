"""Returns measured against the best possible and the best random or constant policy.

The same scale as `pipeline.evaluation.sampled.Yardstick`, for arrays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from verdicts.score_arrays import Floats


def gap_to_optimum(returns: ArrayLike, optimum: float) -> Floats:
    """How far returns stay behind the optimum, elementwise."""
    return optimum - np.asarray(returns, dtype=np.float64)


def optimum_score(returns: ArrayLike, optimum: float, baseline: float) -> Floats:
    """Returns on a scale where 1 is the optimum and 0 the baseline, elementwise.

    Args:
        returns: expected returns, of any shape; NaN stays.
        optimum: the highest expected return of any policy.
        baseline: that of the best random or constant policy. Where no policy beats it,
            a return scores 1 if it reaches the optimum, and else 0.
    """
    figures = np.asarray(returns, dtype=np.float64)
    if optimum == baseline:
        return np.where(np.isnan(figures), np.nan, figures >= optimum)
    return (figures - baseline) / (optimum - baseline)
