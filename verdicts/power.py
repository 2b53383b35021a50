"""How many seeds it takes until a verdict is likely."""

from __future__ import annotations

import math

from scipy import stats

# Nobody runs more; a difference that needs them is as good as none.
MOST_SEEDS = 10_000


def seeds_needed(share: float, level: float = 0.05, power: float = 0.8) -> int | None:
    """About how many seeds the rank-sum test takes to find one agent ahead.

    Args:
        share: the share of pairs of runs that the agent which is ahead wins, ties counting half.
        level: of the one-sided test.
        power: the probability of finding it.

    Returns:
        The number, at least ``fewest_seeds``; None beyond ``MOST_SEEDS``, or where the share is a
        half or less.

    Source: Noether (1987), "Sample size determination for some common nonparametric tests",
    Journal of the American Statistical Association 82(398).
    """
    if not share > 0.5:
        return None
    reach = stats.norm.isf(level) + stats.norm.ppf(power)
    needed = math.ceil(reach**2 / (6 * (share - 0.5) ** 2))
    return max(needed, fewest_seeds(level)) if needed <= MOST_SEEDS else None


def fewest_seeds(level: float) -> int:
    """With how few seeds a claim at this level can be made at all: see ``share_p_value``."""
    return math.ceil(-math.log2(level) - 1e-9)
