"""Whether a trial is hopeless."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np


def is_hopeless(
    scores: Mapping[int, float], others: Sequence[Mapping[int, float]], method: str
) -> bool:
    """Stand-in."""
    if method == "none" or len(scores) < 2:
        return False
    theirs = [
        float(np.mean([each[s] for s in scores])) for each in others if set(scores) <= set(each)
    ]
    return len(theirs) >= 5 and float(np.mean(list(scores.values()))) < float(np.median(theirs))
