"""Axes for returns of very different size."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mdp.array_types import Floats

# Returns that are so many times larger than what matters flatten a linear axis.
DWARFED = 10


def linear_up_to(curves: Iterable[Floats], optimum: float | None) -> float | None:
    """Where a symmetric logarithmic axis ceases to be linear.

    Args:
        curves: returns in the order of time, each of shape (n_points,).
        optimum: the highest expected return, where it is known.

    Returns:
        The optimum's magnitude or, where it is not known, the largest of the returns that the
        curves end with; None where no return dwarfs it, so that a linear axis shows all.
    """
    known = [finite for curve in curves if len(finite := curve[np.isfinite(curve)])]
    if not known:
        return None
    if optimum is None:
        optimum = max(float(np.abs(curve[-max(len(curve) // 4, 1) :]).max()) for curve in known)
    scale = max(abs(optimum), 1.0)
    return scale if max(float(np.abs(curve).max()) for curve in known) > DWARFED * scale else None
