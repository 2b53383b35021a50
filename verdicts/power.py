"""How many seeds it takes: to find a difference, or to show that there is none that matters."""

from __future__ import annotations

from collections.abc import Callable

from scipy import stats

# Nobody runs more; a difference that needs them is as good as none.
MOST_SEEDS = 10_000

# Two seeds leave one degree of freedom, which is too little to plan with.
_FEWEST_SEEDS = 3

# SciPy's noncentral t does not converge far beyond; there the power is 1 anyway.
_LARGEST_EFFECT = 1e4


def seeds_needed(
    difference: float, spread: float, level: float = 0.05, power: float = 0.8
) -> int | None:
    """The smallest number of seeds with which the paired t test finds a difference.

    Args:
        difference: the mean difference.
        spread: the standard deviation of the differences.
        level: of the two-sided test. With several pairs, 0.05 divided by their number suffices
            under Holm's correction, whatever the other pairs show.
        power: the probability of finding it, with the right sign.

    Returns:
        The number, at least 3; None beyond ``MOST_SEEDS``, or where there is no difference or no
        spread to go by.

    Source: Cohen (1988), "Statistical power analysis", chapter 2; exact, by the noncentral t.
    """
    if not spread > 0:
        return None
    effect = abs(difference) / spread
    return _smallest(lambda n: _chance(n, effect, level / 2), power)


def seeds_for_equivalence(
    difference: float, spread: float, margin: float, level: float = 0.05, power: float = 0.8
) -> int | None:
    """The smallest number of seeds with which both one-sided tests show equivalence.

    Args:
        difference: the mean difference.
        spread: the standard deviation of the differences.
        margin: the largest difference that does not matter.
        level: of each test.
        power: the probability that both succeed, or a little less: it is bounded from below.

    Returns:
        The number, at least 3; None beyond ``MOST_SEEDS``, where the difference lies outside the
        margin, or where there is no spread to go by.
    """
    if not spread > 0:
        return None
    near, far = (margin - abs(difference)) / spread, (margin + abs(difference)) / spread
    return _smallest(lambda n: _chance(n, near, level) + _chance(n, far, level) - 1, power)


def _chance(n: int, effect: float, tail: float) -> float:
    """Probability that t exceeds its upper ``tail``.

    Args:
        n: the number of seeds.
        effect: the true mean in standard deviations.
        tail: the probability of exceeding it if the true mean is 0.
    """
    noncentrality = min(effect, _LARGEST_EFFECT) * n**0.5
    return float(stats.nct.sf(stats.t.isf(tail, n - 1), n - 1, noncentrality))


def _smallest(power_with: Callable[[int], float], power: float) -> int | None:
    """The smallest number of seeds that gives the power, found by doubling and halving."""
    enough = _FEWEST_SEEDS
    while power_with(enough) < power:
        if enough >= MOST_SEEDS:
            return None
        enough = min(2 * enough, MOST_SEEDS)
    short = max(enough // 2, _FEWEST_SEEDS - 1)
    while enough - short > 1:
        middle = (short + enough) // 2
        if power_with(middle) < power:
            short = middle
        else:
            enough = middle
    return enough
