"""How much of the promised error rate each look may spend: apart, so that SciPy is not loaded."""

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
