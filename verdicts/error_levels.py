"""How the promised error rate is shared, over looks, environments and questions; without SciPy."""

from __future__ import annotations

# What the first of an unknown number of looks may spend.
FIRST_SHARE = 0.9


def level_of_look(alpha: float, look: int, n_looks: int | None = None) -> float:
    """The error rate of the verdicts at one look, so that all looks together keep ``alpha``.

    Args:
        alpha: the error rate promised for the study.
        look: which look this is, counted from 1.
        n_looks: how many there will be, where that was settled before the first; each then has an
            equal share. None where nobody knows: the first has ``FIRST_SHARE``, the k-th of the
            others 1 / (k (k - 1)) of the rest, which adds up to no more however many there are.

    Raises:
        ValueError: for a look that is none, or beyond those that were settled on.

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


# What each kind of claim may spend of the error rate of a look at an environment. Proven by
# Bonferroni's inequality: a study says nothing wrong as long as none of them does.
SHARES = {"means": 0.75, "typical": 0.1, "failures": 0.07, "fails more": 0.03, "sooner": 0.05}


def level_of_claim(level: float, kind: str) -> float:
    """What one kind of claim, a key of ``SHARES``, may spend of a look's error rate."""
    return SHARES[kind] * level


def level_of_environment(level: float, n_environments: int) -> float:
    """What one environment of a study may spend; all of them together count as one more."""
    return level / (n_environments + 1 if n_environments > 1 else 1)
