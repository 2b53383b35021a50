"""How the error rate of a study is split over looks, environments and claims; without SciPy."""

from __future__ import annotations

# The share of the error rate for the first of an unknown number of looks.
FIRST_SHARE = 0.9


def level_of_look(alpha: float, look: int, n_looks: int | None = None) -> float:
    """The error rate at one look (interim analysis), such that all looks together keep ``alpha``.

    Args:
        alpha: the error rate promised for the study.
        look: which look this is, counted from 1.
        n_looks: the number of looks, if it was fixed before the first; each then has an equal
            share. None if unknown: the first has ``FIRST_SHARE``, and look k after it has
            1 / (k (k - 1)) of the rest, which adds up to no more than the rest.

    Raises:
        ValueError: for a look below 1 or above ``n_looks``.

    Source: Bonferroni's inequality over looks; on spending an error rate, Lan and DeMets (1983),
    "Discrete sequential boundaries for clinical trials", Biometrika 70(3).
    """
    if look < 1 or (n_looks is not None and look > n_looks):
        raise ValueError(f"look is {look}, it must lie between 1 and {n_looks or 'any number'}")
    if n_looks is not None:
        return alpha / n_looks
    if look == 1:
        return FIRST_SHARE * alpha
    return (1 - FIRST_SHARE) * alpha / (look * (look - 1))


# The share of each kind of claim in the error rate of one look at one environment. By Bonferroni's
# inequality, the probability of any wrong claim is at most the sum.
SHARES = {"means": 0.75, "typical": 0.1, "failures": 0.07, "fails more": 0.03, "sooner": 0.05}


def level_of_claim(level: float, kind: str) -> float:
    """The error rate for one kind of claim, a key of ``SHARES``, out of that of a look."""
    return SHARES[kind] * level


def level_of_environment(level: float, n_environments: int) -> float:
    """The error rate for one environment; claims over all environments count as one more."""
    return level / (n_environments + 1 if n_environments > 1 else 1)
