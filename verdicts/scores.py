"""Returns measured against the best possible and the best blind policy.

The same scale as `pipeline.evaluation.sampled.Yardstick`, for arrays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from verdicts.score_arrays import Floats


def gap_to_optimum(returns: ArrayLike, optimum: float) -> Floats:
    """How far returns stay behind the optimum, elementwise."""
    return optimum - np.asarray(returns, dtype=np.float64)


def optimum_score(returns: ArrayLike, optimum: float, blind: float) -> Floats:
    """Returns on a scale where 1 is the optimum and 0 the best blind policy, elementwise.

    Args:
        returns: expected returns, of any shape; NaN stays.
        optimum: the highest expected return of any policy.
        blind: the highest of a policy that ignores what it observes. Where no policy beats it,
            a return scores 1 if it reaches the optimum, and else 0.
    """
    figures = np.asarray(returns, dtype=np.float64)
    if optimum == blind:
        return np.where(np.isnan(figures), np.nan, figures >= optimum)
    return (figures - blind) / (optimum - blind)
